// The list at the left: filters, search, sorting, and as many rows in the page as can be seen.

import { byId, make } from "./dom.js";
import { outcomeColour, outcomeWords } from "./outcomes.js";
import { on, state } from "./store.js";

const ROW = 46; // [px], the height of .row
const SPARE = 6; // rows beyond the edges

let order = []; // numbers of the episodes that pass the filters, in the order of the list
const wanted = new Set(); // outcomes; none means all
let isDescending = false;
let choose = null; // (index, isCompared) => void

export function startList(onChoose) {
  choose = onChoose;
  byId("search").addEventListener("input", refresh);
  byId("sort").addEventListener("change", refresh);
  byId("direction").addEventListener("click", () => {
    isDescending = !isDescending;
    byId("direction").textContent = isDescending ? "↓" : "↑";
    refresh();
  });
  byId("list").addEventListener("scroll", draw);
  new ResizeObserver(draw).observe(byId("list"));
  on("dataset", () => { drawChips(); refresh(); });
  on("episodes", draw);
  on("aimed", draw);
}

// Return the episode that is some rows below the selected one, or the first one if none is selected.
export function neighbour(rows) {
  const at = order.indexOf(state.aimed);
  if (at < 0) return order[0];
  return order[Math.min(order.length - 1, Math.max(0, at + rows))];
}

export function scrollTo(index) {
  const at = order.indexOf(index), list = byId("list");
  if (at < 0) return;
  if (at * ROW < list.scrollTop) list.scrollTop = at * ROW;
  else if ((at + 1) * ROW > list.scrollTop + list.clientHeight) list.scrollTop = (at + 1) * ROW - list.clientHeight;
}

function refresh() {
  const { frames, outcome, task, score, late } = state.dataset.episodes;
  const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const hits = state.dataset.tasks.map((text) => text.toLowerCase());
  const passes = (index) =>
    (wanted.size === 0 || wanted.has(outcome[index])) &&
    words.every((word) => hits[task[index]].includes(word) || `${index}` === word.replace(/^#/, ""));
  order = frames.map((_, index) => index).filter(passes);
  const values = { index: null, frames, score, late }[byId("sort").value];
  const direction = isDescending ? -1 : 1;
  order.sort((i, j) => {
    if (!values) return direction * (i - j);
    const x = values[i], y = values[j];
    if (x === null || y === null) return (x === null) - (y === null) || i - j; // what has none is last, either way
    return direction * (x - y) || i - j;
  });
  const all = frames.length;
  byId("shown").textContent = order.length === all ? `${all} episodes` : `${order.length} of ${all}`;
  byId("list-space").style.height = `${order.length * ROW}px`;
  draw();
}

function drawChips() {
  const counts = new Map();
  for (const one of state.dataset.episodes.outcome) counts.set(one, (counts.get(one) ?? 0) + 1);
  for (const one of wanted) if (!counts.has(one)) wanted.delete(one);
  const chips = [...counts].sort((x, y) => y[1] - x[1]).map(([one, count]) => make("button", {
    class: "chip", style: { "--colour": outcomeColour(one) }, "aria-pressed": `${wanted.has(one)}`, "data-outcome": one,
    onclick: () => {
      if (!wanted.delete(one)) wanted.add(one);
      drawChips();
      refresh();
    },
  }, make("span", { class: "dot" }), outcomeWords(one), make("b", {}, `${count}`)));
  byId("chips").replaceChildren(...chips);
}

function draw() {
  if (!state.dataset) return;
  const list = byId("list");
  const first = Math.max(0, Math.floor(list.scrollTop / ROW) - SPARE);
  const last = Math.min(order.length, Math.ceil((list.scrollTop + list.clientHeight) / ROW) + SPARE);
  const rows = [];
  for (let place = first; place < last; place++) rows.push(row(order[place], place));
  byId("list-space").replaceChildren(...rows);
  const selected = order.slice(first, last).includes(state.aimed) ? `episode-${state.aimed}` : null;
  if (selected) list.setAttribute("aria-activedescendant", selected);
  else list.removeAttribute("aria-activedescendant");
}

function row(index, place) {
  const { frames, outcome, task, score, late, interventions } = state.dataset.episodes;
  const value = score[index] === null ? "" : score[index].toFixed(3);
  const extra = [`${(frames[index] / state.dataset.fps).toFixed(1)} s`];
  if (late[index]) extra.push(`${late[index]} late`);
  if (interventions[index]) extra.push(`${interventions[index]} interv.`);
  const compare = make("button", {
    class: "versus", title: "Compare the selected episode with this one",
    onclick: (event) => { event.stopPropagation(); choose(index, true); },
  }, "compare");
  return make("div", {
    id: `episode-${index}`, class: `row${state.b?.index === index ? " compared" : ""}`, role: "option",
    "aria-selected": `${state.aimed === index}`, "data-episode": `${index}`, "data-outcome": outcome[index],
    style: { top: `${place * ROW}px`, "--colour": outcomeColour(outcome[index]) },
    onclick: (event) => choose(index, event.shiftKey || event.ctrlKey || event.metaKey),
  },
  make("span", { class: "number" }, `${index}`),
  make("span", { class: "outcome" }, make("span", { class: "dot" }), outcomeWords(outcome[index])),
  make("span", { class: "score", title: "score" }, value),
  make("span", { class: "length" }, extra[0]),
  make("span", { class: "task", title: state.dataset.tasks[task[index]] },
    [...extra.slice(1), state.dataset.tasks[task[index]]].join(" · ")),
  state.a && state.a.index !== index ? compare : null);
}
