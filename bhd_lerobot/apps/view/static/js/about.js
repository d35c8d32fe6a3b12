// The line above the views: which episode this is, how it ended, and what was stored about it.

import { byId, make } from "./dom.js";
import { markButtons } from "./marking.js";
import { outcomeColour, outcomeWords } from "./outcomes.js";
import { on, shown, state } from "./store.js";

const MEASURES = { path_m: ["way", "m"], error_m: ["error", "m"], error_rad: ["error", "rad"], lifted_m: ["lifted", "m"] };

export function startAbout(onCompareEnd) {
  const build = () => byId("about").replaceChildren(
    ...shown().map(([name, episode]) => card(name, episode, onCompareEnd)),
    ...(state.a ? [markButtons()] : []));
  on("episodes", build);
}

function card(name, episode, onCompareEnd) {
  const outcome = state.dataset.episodes.outcome[episode.index] ?? "";
  return make("div", { class: `card-${name}`, "data-episode": `${episode.index}` },
    make("span", { class: "who" }, `#${episode.index}`),
    make("span", { class: "badge", style: { "--colour": outcomeColour(outcome) } }, make("span", { class: "dot" }), outcomeWords(outcome)),
    make("span", { class: "instruction" }, episode.instruction),
    make("button", { class: "quiet", title: "Everything that was stored about the episode", onclick: () => showAll(episode) }, "more"),
    make("button", { class: "quiet", title: "Download the episode", onclick: () => showDownloads(episode) }, "download"),
    name === "b" ? make("button", { class: "quiet", title: "End the comparison (c)", onclick: onCompareEnd }, "✕") : null,
    make("span", { class: "facts", title: stored(episode) }, facts(episode).join("  ·  ")));
}

function facts(episode) {
  const { score } = episode.metadata;
  const found = [`${(episode.frames / episode.fps).toFixed(1)} s`, `${episode.frames} ${episode.frames === 1 ? "frame" : "frames"}`];
  if (typeof score === "number") found.push(`score ${score.toFixed(3)}`);
  for (const [key, [word, unit]] of Object.entries(MEASURES)) {
    if (typeof episode.metadata[key] === "number") found.push(`${word} ${episode.metadata[key].toPrecision(3)} ${unit}`);
  }
  const clock = episode.timing?.clock;
  if (clock === "lockstep") found.push("simulated time");
  else if (clock) found.push(`${episode.timing.late_frames ?? 0} late frames, ${episode.timing.skipped ?? 0} ticks skipped`);
  if (episode.plan?.problem) found.push(`problem: ${episode.plan.problem}`);
  return found;
}

function stored(episode) {
  return Object.entries(episode.metadata).map(([key, value]) => `${key}: ${value}`).join("\n");
}

function showDownloads(episode) {
  const dialog = byId("dialog"), path = `/api/episodes/${episode.index}`;
  const name = `${state.dataset.name}-episode-${episode.index}`;
  const link = (href, file, what) =>
    make("p", {}, make("a", { href: `${href}?stamp=${episode.stamp}`, download: file }, file), ` ${what}`);
  const videos = episode.videos.filter(({ kind }) => kind === "video").map(({ key }) => {
    const { label } = state.dataset.cameras.find((camera) => camera.key === key);
    return link(`${path}/videos/${encodeURIComponent(key)}.mp4`, `${name}-${label.replaceAll(/[^\w-]/g, "_")}.mp4`, "the video, not encoded again");
  });
  dialog.replaceChildren(
    make("h2", { tabindex: "-1", autofocus: true }, `Download episode ${episode.index}`),
    link(`${path}/episode.csv`, `${name}.csv`, "all numbers, one line a frame"), ...videos,
    make("div", { class: "end" }, make("button", { onclick: () => dialog.close() }, "Close")));
  dialog.showModal();
}

function showAll(episode) {
  const dialog = byId("dialog");
  const rows = [];
  for (const { when, note, outcome, interventions } of episode.marks) {
    const what = outcome ? `${outcome[0] ?? "nothing"} → ${outcome[1]}` : `interventions ${JSON.stringify(interventions?.[1])}`;
    rows.push([`marked ${when}`, note ? `${what}: ${note}` : what]);
  }
  const { steps = [], done = 0, attempts } = episode.plan ?? {};
  steps.forEach((one, number) => rows.push([`step ${number + 1}`, `${number < done ? "✓ " : ""}${one[1] ?? one}`]));
  if (attempts > 1) rows.push(["attempts", attempts]);
  rows.push(...Object.entries(episode.metadata));
  for (const [frame, name, code, message] of episode.goals) rows.push([`goal ${name}`, `${code} in frame ${frame}: ${message}`]);
  for (const [key, value] of Object.entries(episode.timing ?? {})) rows.push([`timing: ${key}`, value]);
  const text = (value) => (typeof value === "object" ? JSON.stringify(value) : `${value}`);
  const breakable = (value) => text(value).split(/(?<=,)/).flatMap((part) => [part, make("wbr")]); // JSON has no spaces
  dialog.replaceChildren(
    make("h2", { tabindex: "-1", autofocus: true }, `Episode ${episode.index}`),
    rows.length ? make("table", {}, ...rows.map(([key, value]) => make("tr", {}, make("td", {}, key), make("td", {}, ...breakable(value)))))
      : make("p", {}, "Nothing but its frames was stored."),
    make("div", { class: "end" }, make("button", { onclick: () => dialog.close() }, "Close")));
  dialog.showModal();
}
