// Keys, and the page that lists them.

import { pause, play, seek, setRate, step } from "./clock.js";
import { byId, make } from "./dom.js";
import { duration, state } from "./store.js";

const HELP = [
  ["space", "play, pause"],
  ["← →", "a frame back, on"],
  ["shift ← →", "a second back, on"],
  ["home, end", "to the start, the end"],
  ["1 2 3", "speed 0.5×, 1×, 2×"],
  ["↑ ↓", "the episode above, below"],
  ["c", "compare with the episode before, or end it"],
  ["shift-click", "compare with this episode"],
  ["/", "search"],
  ["drag, double click", "in a plot: show a segment of time, all of it"],
  ["click", "in a plot: go there"],
  ["esc", "close, leave the search"],
];

export function startKeys({ move, compare }) {
  byId("help-button").addEventListener("click", showHelp);
  const actions = {
    " ": () => (state.playing ? pause() : play()),
    ArrowUp: () => move(-1), ArrowDown: () => move(1), PageUp: () => move(-10), PageDown: () => move(10),
    Home: () => seek(0), End: () => seek(duration()),
    ArrowLeft: (event) => step(event.shiftKey ? -state.a.fps : -1),
    ArrowRight: (event) => step(event.shiftKey ? state.a.fps : 1),
    1: () => setRate(0.5), 2: () => setRate(1), 3: () => setRate(2),
    c: compare, "?": showHelp, "/": () => byId("search").focus(),
  };
  document.addEventListener("keydown", (event) => {
    if (byId("dialog").open || event.ctrlKey || event.metaKey || event.altKey) return;
    const isTyping = event.target.matches?.("input, textarea, select");
    if (isTyping) {
      if (event.key === "Escape") event.target.blur();
      if (!(event.target.id === "search" && ["ArrowUp", "ArrowDown"].includes(event.key))) return;
    }
    if (event.key === " " && event.target.matches?.("button, summary")) return; // it presses what has the focus
    const action = actions[event.key];
    if (!action || (!state.a && !["?", "/", "ArrowDown", "ArrowUp"].includes(event.key))) return;
    event.preventDefault();
    action(event);
  });
}

function showHelp() {
  const dialog = byId("dialog");
  dialog.replaceChildren(make("h2", {}, "Keys"),
    make("table", {}, ...HELP.map(([key, what]) => make("tr", {}, make("td", {}, make("kbd", {}, key)), make("td", {}, what)))),
    make("div", { class: "end" }, make("button", { onclick: () => dialog.close() }, "Close")));
  dialog.showModal();
}
