// The row of views: which ones there are for the shown episodes, and that all follow the time.

import { drawArm } from "./arm_view.js";
import { byId, make } from "./dom.js";
import { cameraView } from "./videos.js";
import { drawScan } from "./scan_view.js";
import { sceneView } from "./scene_view.js";
import { on, shown, state } from "./store.js";
import { drawTop, sameScene } from "./top_view.js";

const WIDTH = 220; // [px] that a view should have, or there are two rows of them

let followers = []; // functions that show the present time

export function startViews() {
  on("episodes", build);
  on("time", follow);
  on("playing", follow);
  on("theme", follow);
  new ResizeObserver(arrange).observe(byId("views"));
}

function arrange() {
  byId("views").classList.toggle("rows", followers.length > 0 && byId("views").children.length * WIDTH > byId("views").clientWidth);
}

const follow = () => followers.forEach((show) => show());

function build() {
  const cards = [...cameras(), ...scans(), ...tops(), ...arms(), ...scenes()];
  followers = cards.flatMap((card) => card.follow);
  byId("views").replaceChildren(...cards.map((card) => card.element));
  byId("views").hidden = cards.length === 0;
  arrange();
  follow();
}

function card(kind, title, { output = null, follow: show }, ...inside) {
  const heading = make("h2", {}, make("span", { title }, title), output);
  const element = make("section", { class: "view", "data-view": kind },
    heading, make("div", { class: "inside" }, ...inside));
  return { element, follow: show };
}

function drawing(kind, title, label, draw, options = {}) {
  const canvas = make("canvas", { role: "img", "aria-label": label });
  const show = () => { if (canvas.clientWidth > 0) draw(canvas); };
  new ResizeObserver(show).observe(canvas);
  return card(kind, title, { ...options, follow: [show] }, canvas);
}

// Height and width of an image, whose channels may come first or last.
function aspect([one, two, three]) {
  if (!(one > 0 && two > 0)) return [3, 4];
  return one <= 4 && three > 4 ? [two, three] : [one, two];
}

function cameras() {
  return state.dataset.cameras.map((camera) => {
    const sources = shown().flatMap(([name, episode]) => {
      const about = episode.videos.find((one) => one.key === camera.key);
      return about ? [[name, cameraView(camera, episode, about)]] : [];
    });
    for (const [name, one] of sources) {
      one.element.classList.add(name);
      one.element.classList.toggle("paired", sources.length > 1);
    }
    const made = card("video", `camera ${camera.label}`, { follow: sources.map(([, one]) => one.show) },
      ...sources.map(([, one]) => one.element));
    const [high, wide] = aspect(camera.shape);
    made.element.classList.add("of-video");
    made.element.style.setProperty("--aspect", `${(wide * sources.length) / (high * 1.08)}`); // its heading takes some
    if (sources.length > 1) stacking(made.element.querySelector(".inside"), wide / high);
    return made;
  });
}

// Two videos lie beside or above each other, whichever makes them larger.
function stacking(box, ratio) {
  new ResizeObserver(() => {
    const { clientWidth: wide, clientHeight: high } = box;
    box.classList.toggle("stacked", Math.min(wide / ratio, high / 2) > Math.min(wide / 2 / ratio, high));
  }).observe(box);
}

function scans() {
  if (!shown().some(([, episode]) => episode.views.scan)) return [];
  const output = make("output", { title: "of the selected episode" });
  return [drawing("scan", "scan, ahead is up", "laser scan around the robot", (canvas) => drawScan(canvas, output), { output })];
}

// Episodes in the same surroundings are drawn into one image, others side by side.
function groups(has) {
  const there = shown().filter(([, episode]) => has(episode));
  return there.length === 2 && !sameScene(there[0][1], there[1][1]) ? there.map((one) => [one]) : there.length ? [there] : [];
}

const numbers = (together) => (state.b ? ` · ${together.map(([, episode]) => `episode ${episode.index}`).join(", ")}` : "");

function tops() {
  return groups((episode) => episode.views.base).map((together) => {
    const odometry = together[0][1].views.base.from === "odometry" ? "odometry from above" : "from above";
    return drawing("top", odometry + numbers(together), "the robot's way from above", (canvas) => drawTop(canvas, together));
  });
}

function arms() {
  return groups((episode) => episode.views.arm).flatMap((together) => [
    drawing("arm-above", `from above${numbers(together)}`, "the arm from above", (canvas) => drawArm(canvas, "above", together)),
    drawing("arm-side", `from the side${numbers(together)}`, "the arm from the side", (canvas) => drawArm(canvas, "side", together)),
  ]);
}

function scenes() {
  return groups((episode) => episode.views.arm || episode.views.base).map((together, place) => {
    const { elements, show } = sceneView(together, place);
    return card("scene", `in three dimensions${numbers(together)}`, { follow: [show] }, ...elements);
  });
}
