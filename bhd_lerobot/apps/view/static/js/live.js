// A robot that runs, drawn as an episode of one frame that is always the newest.

import { byId } from "./dom.js";
import { emit, state } from "./store.js";
import { startTheme } from "./theme.js";
import { startViews } from "./views.js";

const SILENT_S = 0.5; // so old a state of a running robot is worth a word
let newest = null; // what was sent and is not drawn yet
let built = null; // where a base was when the views were made that show its surroundings

function begin({ title, views, scene }, arrays) {
  const made = Object.entries(arrays).map(([name, values]) => [name, { name, values: new Float32Array(values.length), width: values.length }]);
  state.a = {
    index: 0, frames: 1, fps: 1, metadata: {}, interventions: [], videos: [], views, scene, arrays: Object.fromEntries(made),
  };
  document.title = `${title} – bhd-monitor`;
  byId("name").textContent = title;
}

function fill(arrays) {
  for (const [name, values] of Object.entries(arrays)) state.a.arrays[name].values.set(values.map((value) => value ?? NaN));
}

// Where nothing is known of the surroundings, what is shown is as large as the way so far.
function hasLeft() {
  const [x, y] = state.a.arrays["view.base"]?.values ?? [];
  return !state.a.scene && x !== undefined && built !== null && Math.hypot(x - built[0], y - built[1]) > 0.4;
}

function show({ about, arrays, mode, phase, estop, age }) {
  const isOld = phase === "running" && age > SILENT_S;
  byId("state").textContent = [mode ?? "unknown mode", `loop ${phase}`, estop ? "emergency stop" : ""].filter(Boolean).join(" · ");
  say(isOld ? `The newest state is ${age.toFixed(1)} s old: the cerebellum's process publishes nothing.` : "");
  if (!arrays) return;
  if (about) begin(about, arrays);
  fill(arrays);
  if (about || hasLeft()) {
    built = [...(state.a.arrays["view.base"]?.values ?? [])];
    emit("episodes");
  }
  emit("time");
  document.body.dataset.ready = "yes";
}

function say(text) {
  byId("banner").hidden = text === "";
  byId("banner").querySelector("span").textContent = text;
}

state.dataset = { cameras: [] };
startTheme();
startViews();
const source = new EventSource("/api/live"); // connects again by itself, and is then sent everything anew
source.onmessage = ({ data }) => {
  const message = JSON.parse(data);
  const isFree = newest === null; // what cannot be drawn as fast as it comes is left out
  newest = newest?.about ? { about: newest.about, ...message } : message;
  if (isFree) requestAnimationFrame(() => {
    const shown = newest;
    newest = null;
    show(shown);
  });
};
source.onerror = () => say("The monitor does not answer: it was left, or the robot has ended. Start bhd-monitor --3d again.");
