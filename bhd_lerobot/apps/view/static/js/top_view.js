// A base from above: what stands around it, its way, where it is, and what its scanner sees from there.

import { colour, disc, fit, polyline, prepare } from "./canvas.js";
import { beams, reach } from "./scan_view.js";
import { frameAt } from "./store.js";

export const WALL = 0.1; // [m] thickness of the outer walls

// Draw one or two episodes in one arena. `together` are pairs of a colour's name and an episode.
export function drawTop(canvas, together) {
  const { context, width, height } = prepare(canvas);
  const scene = together[0][1].scene;
  const arena = scene?.kind === "arena" ? scene : null;
  const { scale, point } = fit(arena ? widened(arena.extent, 0.1) : around(together), [0, 0, width, height]);
  if (arena) drawArena(context, arena, scale, point);
  else drawGrid(context, width, height, scale, point);
  for (const [name, episode] of [...together].reverse()) drawRobot(context, name, episode, scale, point);
  canvas.dataset.frame = frameAt(together[0][1]);
}

export const sameScene = (one, other) => JSON.stringify(one.scene) === JSON.stringify(other.scene);

const widened = ([x0, x1, y0, y1], by) => [x0 - by, x1 + by, y0 - by, y1 + by];

function around(together) {
  const box = [-0.5, 0.5, -0.5, 0.5];
  for (const [, episode] of together) {
    for (let frame = 0; frame < episode.frames; frame++) {
      const [x, y] = pose(episode, frame);
      if (!Number.isFinite(x) || !Number.isFinite(y)) continue;
      box[0] = Math.min(box[0], x - 0.4);
      box[1] = Math.max(box[1], x + 0.4);
      box[2] = Math.min(box[2], y - 0.4);
      box[3] = Math.max(box[3], y + 0.4);
    }
  }
  return box;
}

function pose(episode, frame) {
  const { values } = episode.arrays["view.base"];
  return [values[3 * frame], values[3 * frame + 1], values[3 * frame + 2]];
}

function drawArena(context, arena, scale, point) {
  const [x0, x1, y0, y1] = arena.extent;
  const [left, top] = point(x0, y1);
  context.fillStyle = colour("--floor");
  context.fillRect(left, top, (x1 - x0) * scale, (y1 - y0) * scale);
  context.fillStyle = colour("--wall");
  context.save();
  context.beginPath(); // what is built beyond the outer walls is not seen from within
  context.rect(left - WALL * scale, top - WALL * scale, (x1 - x0 + 2 * WALL) * scale, (y1 - y0 + 2 * WALL) * scale);
  context.clip();
  for (const [kind, x, y, yaw, sizeX, sizeY] of arena.shapes) {
    if (kind === "cylinder") disc(context, point(x, y), sizeX * scale);
    else corners(context, x, y, yaw, sizeX, sizeY, point);
    context.fill();
  }
  context.restore();
  if (arena.goal) drawGoal(context, arena.goal, point);
}

function corners(context, x, y, yaw, halfX, halfY, point) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  context.beginPath();
  for (const [i, j] of [[1, 1], [-1, 1], [-1, -1], [1, -1]]) {
    context.lineTo(...point(x + c * i * halfX - s * j * halfY, y + s * i * halfX + c * j * halfY));
  }
  context.closePath();
}

function drawGoal(context, [x, y, yaw], point) {
  const [px, py] = point(x, y);
  context.strokeStyle = colour("--text");
  context.lineWidth = 2;
  polyline(context, [[px - 6, py], [px + 6, py]]);
  polyline(context, [[px, py - 6], [px, py + 6]]);
  polyline(context, [[px, py], [px + 16 * Math.cos(yaw), py - 16 * Math.sin(yaw)]]);
}

function drawGrid(context, width, height, scale, point) {
  context.strokeStyle = colour("--line");
  context.lineWidth = 1;
  const [x0, y0] = point(0, 0);
  for (let x = x0 % scale; x < width; x += scale) polyline(context, [[x, 0], [x, height]]);
  for (let y = y0 % scale; y < height; y += scale) polyline(context, [[0, y], [width, y]]);
  context.fillStyle = colour("--muted");
  context.font = "10px system-ui, sans-serif";
  context.fillText("1 m squares", 6, height - 6);
}

function drawRobot(context, name, episode, scale, point) {
  const now = frameAt(episode), hue = colour(`--${name}`);
  const step = Math.ceil(episode.frames / 3000); // more points than pixels only take time
  const way = (first, last) => {
    const points = [];
    const end = Math.min(last, episode.frames - 1);
    for (let frame = Math.max(0, first); frame < end; frame += step) points.push(point(...pose(episode, frame)));
    return [...points, point(...pose(episode, end))];
  };
  context.strokeStyle = hue;
  context.lineWidth = 1.2;
  context.globalAlpha = 0.4;
  polyline(context, way(0, episode.frames - 1));
  context.globalAlpha = 1;
  context.lineWidth = 2.2;
  polyline(context, way(0, now));
  context.strokeStyle = colour("--odd"); // where somebody else drove
  for (const [first, end] of episode.interventions) polyline(context, way(first, Math.min(end, now)));
  const [x, y, yaw] = pose(episode, now);
  if (![x, y, yaw].every(Number.isFinite)) return;
  if (episode.views.scan) drawSeen(context, episode, now, [x, y, yaw], point, hue);
  drawEnd(context, episode, point, hue);
  const start = point(...pose(episode, 0));
  context.fillStyle = hue;
  disc(context, start, 3);
  context.fill();
  body(context, point(x, y), yaw, Math.max(6, episode.views.base.radius * scale), hue);
}

function drawSeen(context, episode, frame, [x, y, yaw], point, hue) {
  const range = reach(episode), ahead = episode.views.scan.x;
  const from = [x + ahead * Math.cos(yaw), y + ahead * Math.sin(yaw)];
  context.fillStyle = hue;
  for (const [angle, distance] of beams(episode, frame)) {
    if (!Number.isFinite(distance) || distance >= range - 1e-3) continue;
    disc(context, point(from[0] + distance * Math.cos(yaw + angle), from[1] + distance * Math.sin(yaw + angle)), 1.3);
    context.fill();
  }
}

function drawEnd(context, episode, point, hue) {
  const outcome = episode.metadata.outcome;
  if (!outcome || outcome === "success" || outcome === "timeout") return;
  const [x, y] = point(...pose(episode, episode.frames - 1));
  context.strokeStyle = hue;
  context.lineWidth = 2.5;
  polyline(context, [[x - 5, y - 5], [x + 5, y + 5]]);
  polyline(context, [[x - 5, y + 5], [x + 5, y - 5]]);
}

function body(context, [x, y], yaw, radius, hue) {
  context.fillStyle = hue;
  context.strokeStyle = colour("--panel");
  context.lineWidth = 1.5;
  disc(context, [x, y], radius);
  context.fill();
  context.stroke();
  context.lineWidth = 2.2;
  polyline(context, [[x, y], [x + 0.85 * radius * Math.cos(yaw), y - 0.85 * radius * Math.sin(yaw)]]);
}
