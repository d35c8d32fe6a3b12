// The bar below the views: play, scrub, and what happened when.

import { colour, prepare } from "./canvas.js";
import { pause, play, seek, setRate } from "./clock.js";
import { byId, make, seconds } from "./dom.js";
import { outcomeColour } from "./outcomes.js";
import { duration, emit, frameAt, on, shown, state, segments } from "./store.js";

const RATES = [0.5, 1, 2];
const MOST_RUNS = 400; // of a band as elements of the page
const HUES = ["--line-0", "--line-2", "--line-1", "--line-3", "--line-6", "--line-5", "--line-4"];
let painters = []; // draw the lanes that are canvases

export function startTimeline() {
  on("episodes", build);
  on("time", show);
  on("playing", showTransport);
  on("theme", () => painters.forEach((paint) => paint()));
  on("hover", showHover);
}

function build() {
  painters = [];
  const lanes = [rulerLane(), ...shown().flatMap(([name, episode]) => episodeLanes(name, episode))];
  const track = make("div", {
    id: "track", role: "slider", tabindex: "0", "aria-label": "Time", "aria-valuemin": "0", "aria-valuemax": `${duration()}`,
  }, make("div", { class: "lane-marks" }, ...lanes.map((lane) => lane.element)),
  make("div", { id: "hoverhead", hidden: true }), make("div", { id: "playhead" }));
  scrubbing(track);
  byId("timeline").replaceChildren(transport(), make("div", { class: "lanes" },
    make("div", { class: "lane-names" }, ...lanes.map((lane) => make("span", { class: lane.thin ? "thin" : "", title: lane.name }, lane.name))),
    track));
  new ResizeObserver(() => painters.forEach((paint) => paint())).observe(track);
  showTransport();
  show();
}

function transport() {
  const speeds = RATES.map((rate) => make("button", { "data-rate": `${rate}`, onclick: () => setRate(rate) }, `${rate}×`));
  return make("div", { class: "transport" },
    make("button", { id: "play", title: "Play or pause (space)", onclick: () => (state.playing ? pause() : play()) }),
    make("div", { class: "speeds", role: "group", "aria-label": "Speed" }, ...speeds),
    make("span", { id: "clock" }), make("span", { id: "frame" }), make("span", { id: "now" }));
}

function showTransport() {
  const button = byId("play");
  if (!button) return;
  button.textContent = state.playing ? "❚❚" : "▶";
  button.setAttribute("aria-label", state.playing ? "Pause" : "Play");
  for (const one of document.querySelectorAll(".speeds button")) {
    one.setAttribute("aria-pressed", `${Number(one.dataset.rate) === state.rate}`);
  }
}

function show() {
  if (!state.a || !byId("track")) return;
  const whole = duration(), frame = frameAt(state.a);
  byId("playhead").style.left = `${(100 * state.time) / whole}%`;
  byId("track").setAttribute("aria-valuenow", state.time.toFixed(3));
  byId("track").setAttribute("aria-valuetext", seconds(state.time));
  byId("track").dataset.frame = frame;
  byId("clock").textContent = `${state.time.toFixed(2)} / ${seconds(whole)}`;
  byId("frame").textContent = `frame ${frame} of ${state.a.frames}`;
  byId("now").textContent = state.a.bands.flatMap((band) => band.runs)
    .filter(([first, end]) => first <= frame && frame < end).map((run) => run[2]).join(" · ");
  for (const run of document.querySelectorAll(".run")) {
    run.classList.toggle("past", Number(run.dataset.end) <= frameAt(run.dataset.of === "b" ? state.b ?? state.a : state.a));
  }
}

function showHover(time) {
  const head = byId("hoverhead");
  if (!head) return;
  head.hidden = time === null;
  if (time !== null) head.style.left = `${(100 * time) / duration()}%`;
}

function scrubbing(track) {
  const timeAt = (event) => {
    const box = track.getBoundingClientRect();
    return ((event.clientX - box.left) / box.width) * duration();
  };
  track.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    track.setPointerCapture(event.pointerId);
    pause();
    seek(timeAt(event));
  });
  track.addEventListener("pointermove", (event) => {
    if (track.hasPointerCapture(event.pointerId)) seek(timeAt(event));
    else emit("hover", Math.min(Math.max(0, timeAt(event)), duration()));
  });
  track.addEventListener("pointerleave", () => emit("hover", null));
}

function rulerLane() {
  const whole = duration();
  const each = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800].find((one) => whole / one <= 12) ?? 3600;
  const marks = [];
  for (let time = 0; time <= whole + 1e-9; time += each) {
    const left = { left: `${(100 * time) / whole}%` };
    const edge = time === 0 ? "first" : time > 0.985 * whole ? "last" : "";
    marks.push(make("i", { style: left }), make("b", { class: edge, style: left }, `${+time.toFixed(2)}`));
  }
  return { name: "time [s]", element: make("div", { class: "lane ruler" }, ...marks) };
}

function episodeLanes(name, episode) {
  const suffix = state.b ? ` ${episode.index}` : "";
  const lanes = episode.bands.map((band) => bandLane(`${band.name}${suffix}`, name, episode, band.runs));
  if (episode.interventions.length) {
    const runs = episode.interventions.map(([first, end, why]) => [first, end, why || "intervention"]);
    lanes.push(bandLane(`intervention${suffix}`, name, episode, runs, "--odd"));
  }
  if (episode.events.length) lanes.push(eventLane(`events${suffix}`, name, episode));
  const flagged = [
    ["limited", "control.limits", "--warn"], ["watchdog", "control.watchdog", "--bad"],
    ["late", "control.late", "--bad"], ["skipped", "control.skipped", "--bad"],
  ];
  for (const [title, key, hue] of flagged) {
    const column = episode.arrays[key];
    if (column?.values.some((value) => value)) lanes.push(flagLane(`${title}${suffix}`, name, episode, column.values, hue));
  }
  return lanes;
}

const share = (frame, episode) => (100 * frame) / episode.fps / duration();
const laneClass = (name) => `lane${name === "b" ? " of-b" : ""}`;

function bandLane(title, name, episode, runs, fixed = null) {
  const words = [...new Set(runs.map((run) => run[2]))];
  if (runs.length > MOST_RUNS) return dense(title, name, episode, runs, words);
  const parts = runs.map(([first, end, text]) => make("div", {
    class: "run", title: `${text}: ${seconds(first / episode.fps)} to ${seconds(end / episode.fps)}`,
    "data-end": `${end}`, "data-of": name,
    style: {
      left: `${share(first, episode)}%`, width: `${share(end - first, episode)}%`,
      "--colour": `var(${fixed ?? HUES[words.indexOf(text) % HUES.length]})`,
    },
  }, share(end - first, episode) < 2 ? null : `${text}`)); // half a letter says nothing; the title says all
  return { name: title, element: make("div", { class: laneClass(name), "data-lane": title }, ...parts) };
}

// A band whose text changes so often that nobody could read it: colours only; what holds now is said above.
function dense(title, name, episode, runs, words) {
  const numbers = new Map(words.map((word, number) => [word, number]));
  return painted(title, name, (context, height, each) => {
    for (const [first, end, text] of runs) {
      context.fillStyle = colour(HUES[numbers.get(text) % HUES.length]);
      context.fillRect(first * each, 0, Math.max(1, (end - first) * each), height);
    }
  }, episode);
}

function eventLane(title, name, episode) {
  const marks = episode.events.map(([frame, what]) => {
    const isLate = share(frame, episode) > 80;
    return make("span", {
      class: "event", title: `${what} in frame ${frame}`,
      style: {
        "--colour": outcomeColour(what.replaceAll(" ", "_")),
        ...(isLate ? { right: `${100 - share(frame + 1, episode)}%` } : { left: `${share(frame, episode)}%` }),
      },
    }, what);
  });
  return { name: title, element: make("div", { class: laneClass(name), "data-lane": title }, ...marks) };
}

function flagLane(title, name, episode, values, hue) {
  return painted(title, name, (context, height, each) => {
    context.fillStyle = colour(hue);
    for (const [first, end] of segments(values)) context.fillRect(first * each, 0, Math.max(1, (end - first) * each), height);
  }, episode);
}

function painted(title, name, paint, episode) {
  const canvas = make("canvas", { role: "img", "aria-label": `${title}: in which frames` });
  painters.push(() => {
    if (!canvas.clientWidth) return;
    const { context, width, height } = prepare(canvas);
    paint(context, height, (width * share(1, episode)) / 100);
  });
  return { name: title, thin: true, element: make("div", { class: `${laneClass(name)} thin`, "data-lane": title }, canvas) };
}
