// Plots over time: sections that can be closed, of which only the open ones are drawn.

import { colour } from "./canvas.js";
import { seek, pause } from "./clock.js";
import { byId, make } from "./dom.js";
import { duration, emit, frameAt, on, shown, state, segments } from "./store.js";

const HEIGHT = 108; // [px] of a plot without its legend
const SYNC = "bhd";
const REQUESTED = "requested";
const opened = new Map(); // title of a section -> whether it was opened or closed by hand
let plots = []; // {plot, playhead, box}
let isHovered = false;

export function startPlots() {
  on("episodes", build);
  on("time", follow);
  on("theme", build);
  on("hover", hover);
}

function build() {
  for (const one of plots) one.plot.destroy();
  plots = [];
  if (!state.a) return byId("plots").replaceChildren();
  byId("plots").replaceChildren(...state.a.sections.map(section));
}

function section(about) {
  const grid = make("div", { class: "plot-grid" });
  const isOpen = opened.get(about.title) ?? about.open;
  const details = make("details", { open: isOpen, "data-section": about.title },
    make("summary", {}, about.title, ...remarks(about)), grid);
  const fill = () => {
    if (details.open && !grid.hasChildNodes()) about.plots.forEach((one) => grid.append(box(about, one)));
    follow();
  };
  details.addEventListener("toggle", () => {
    opened.set(about.title, details.open);
    fill();
  });
  if (isOpen) queueMicrotask(fill); // when the grid is in the page and has a width
  return details;
}

// What is shaded in a section's plots, and what cannot be drawn.
function remarks(about) {
  const told = [];
  const shade = (name, text) => told.push(make("small", {}, make("span", { class: "swatch", style: { background: `var(${name})` } }), text));
  if (about.kind === "action" && flagged("control.limits")) {
    const words = Object.entries(state.a.flags.limits).filter(([bit]) => state.a.arrays["control.limits"].values.some((v) => v & bit));
    shade("--shade-limit", `the limiter changed the command${whose()}: ${words.map(([, word]) => word).join(", ")}`);
  }
  if (about.kind === "timing" && flagged("control.late")) shade("--shade-late", `frame out of tolerance${whose()}`);
  if (state.a.interventions.length) shade("--shade-taken", `intervention${whose()}`);
  if (state.b) {
    const isPlain = about.plots.every((one) => one.lines.length === 1 || one.lines.some((line) => line.applied));
    if (isPlain) shown().forEach(([name, episode]) => shade(`--${name}`, `episode ${episode.index}`));
    else told.push(make("small", {}, `where there are several lines, episode ${state.b.index} is dashed`));
  }
  const columns = new Set(about.plots.flatMap((one) => one.lines.map((line) => line.column)));
  for (const [key, count] of Object.entries(state.a.not_finite)) {
    if (columns.has(key)) told.push(make("small", { class: "problem" }, `${count} ${count === 1 ? "value is" : "values are"} not finite`));
  }
  return told;
}

const whose = () => (state.b ? ` of episode ${state.a.index}` : "");

const flagged = (key) => state.a.arrays[key]?.values.some((value) => value);

function box(about, one) {
  const place = make("div", { class: "plot", "data-plot": one.title },
    make("h3", {}, one.title, make("span", {}, one.unit ? `[${one.unit}]` : "")));
  requestAnimationFrame(() => {
    if (!place.isConnected) return;
    const plot = new uPlot(options(about, one, place.clientWidth), data(one), place);
    const playhead = make("div", { class: "playhead" });
    plot.over.append(playhead);
    clicking(plot);
    const drawn = { plot, playhead };
    plots.push(drawn);
    new ResizeObserver(() => {
      if (!place.isConnected) return;
      if (plot.width !== place.clientWidth) plot.setSize({ width: place.clientWidth, height: HEIGHT });
      followOne(drawn); // a new size forgets the legend
    }).observe(place);
  });
  return place;
}

function lines(one) {
  // Where there is one line, or a requested and an applied one, two episodes have the colours that they have elsewhere.
  const isPlain = one.lines.length === 1 || one.lines.some((line) => line.applied);
  return shown().flatMap(([name, episode]) => one.lines.filter((line) => episode.arrays[line.column]).map((line, number) => ({
    ...line, name, episode, hue: colour(state.b && isPlain ? `--${name}` : `--line-${number % 8}`),
    isDashed: name === "b" && !isPlain, isRequested: line.label === REQUESTED,
    label: state.b ? `${line.label} #${episode.index}` : line.label,
  })));
}

function data(one) {
  const length = Math.max(...shown().map(([, episode]) => episode.frames));
  const times = Float64Array.from({ length }, (_, frame) => frame / state.a.fps);
  return [times, ...lines(one).map(({ column, number, scale = 1, episode }) => {
    const { values, width } = episode.arrays[column];
    return Array.from({ length }, (_, frame) => {
      const value = frame < episode.frames ? values[frame * width + number] * scale : null;
      return Number.isFinite(value) ? value : null; // a gap
    });
  })];
}

function options(about, one, width) {
  const grid = { stroke: colour("--line"), width: 1 };
  const axis = { stroke: colour("--muted"), grid, ticks: { show: false }, font: "10px system-ui, sans-serif", gap: 2 };
  const series = lines(one).map((line) => ({
    label: line.label,
    stroke: line.hue,
    width: line.isRequested ? 4 : 1.5, // the applied value is a thin line on the broad one of the requested value
    alpha: line.isRequested ? 0.35 : 1,
    pxAlign: 0, // or broad and thin lines of the same values lie beside each other
    dash: line.isDashed ? [5, 4] : undefined,
    points: { show: line.episode.frames < 3, size: 5 },
    value: (_, value) => (value === null || value === undefined ? "–" : short(value)),
  }));
  return {
    width, height: HEIGHT, series: [{ label: "t", value: (_, value) => (value === null ? "–" : `${value.toFixed(2)} s`) }, ...series],
    scales: { x: { time: false, range: (_, min, max) => [min ?? 0, max > min ? max : (min ?? 0) + 1 / state.a.fps] }, y: { range: padded } },
    padding: [5, 8, 0, 0],
    axes: [{ ...axis, size: 18, space: 44 }, { ...axis, size: 46, space: 20, values: (_, values) => values.map(short) }],
    cursor: { sync: { key: SYNC, scales: ["x", null] }, drag: { x: true, y: false }, points: { size: 5 }, y: false },
    legend: { live: true },
    hooks: {
      drawClear: [(plot) => shading(plot, about)],
      setCursor: [(plot) => hovered(plot)],
    },
  };
}

// Three digits, as short as they can be written.
function short(value) {
  const text = Number(value.toPrecision(3)).toString();
  return text.length > 7 ? value.toExponential(1).replace(".0e", "e") : text;
}

// Some room above and below, and a range for lines that never move.
function padded(_, min, max) {
  if (min === null || min === undefined) return [0, 1];
  const room = max > min ? 0.06 * (max - min) : 0.05 * Math.abs(max) || 1;
  return [min - room, max + room];
}

function shading(plot, about) {
  const fill = (name, where) => {
    const { left, top, width, height } = plot.bbox;
    plot.ctx.save();
    plot.ctx.beginPath();
    plot.ctx.rect(left, top, width, height);
    plot.ctx.clip();
    plot.ctx.fillStyle = colour(name);
    for (const [first, end] of where) {
      const from = plot.valToPos(first / state.a.fps, "x", true), to = plot.valToPos(end / state.a.fps, "x", true);
      plot.ctx.fillRect(from, top, Math.max(1, to - from), height);
    }
    plot.ctx.restore();
  };
  if (state.a.interventions.length) fill("--shade-taken", state.a.interventions);
  if (about.kind === "action") fill("--shade-limit", segments(state.a.arrays["control.limits"]?.values));
  if (about.kind === "timing") fill("--shade-late", segments(state.a.arrays["control.late"]?.values));
}

function follow() {
  plots.forEach(followOne);
}

function followOne({ plot, playhead }) {
  if (!state.a) return;
  const left = plot.valToPos(state.time, "x");
  playhead.style.transform = `translateX(${left}px)`;
  playhead.hidden = !(left >= -1 && left <= plot.over.clientWidth + 1);
  playhead.dataset.frame = frameAt(state.a);
  if (!isHovered) plot.setLegend({ idx: Math.min(plot.data[0].length - 1, Math.floor(state.time * state.a.fps + 1e-6)) }, false);
}

function hovered(plot) {
  if (!plot.cursor.event || !plot.over.matches(":hover")) return;
  emit("hover", plot.cursor.left < 0 ? null : Math.min(duration(), Math.max(0, plot.posToVal(plot.cursor.left, "x"))));
}

// The mouse is over a plot, which uPlot shows in all, or over the timeline, which is shown here.
function hover(time) {
  isHovered = time !== null;
  if (time === null) follow();
  else if (byId("track")?.matches(":hover")) {
    for (const { plot } of plots) plot.setLegend({ idx: Math.min(plot.data[0].length - 1, Math.floor(time * state.a.fps)) }, false);
  }
}

function clicking(plot) {
  let from = null;
  plot.over.addEventListener("pointerdown", (event) => { from = event.clientX; });
  plot.over.addEventListener("click", (event) => {
    if (from === null || Math.abs(event.clientX - from) > 3) return; // a drag has chosen a segment
    pause();
    seek(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
  });
  plot.over.addEventListener("pointerleave", () => emit("hover", null));
}
