// An arm from above and from the side, as the capsules that the collision checks take it for, with what lies before it.

import { colour, disc, fit, hull, polyline, prepare } from "./canvas.js";
import { frameAt } from "./store.js";

// Which coordinates go to the right and up, and what is nearer to the eye.
const SIDES = {
  above: { right: 0, up: 1, depth: (p) => p[2] },
  side: { right: 0, up: 2, depth: (p) => -p[1] }, // from the right: y points away
};

export function drawArm(canvas, side, together) {
  const { context, width, height } = prepare(canvas);
  const look = SIDES[side];
  const { scale, point } = fit(bounds(together, look), [0, 0, width, height], 10);
  const at = (p) => point(p[look.right], p[look.up]);
  if (side === "above") drawGrid(context, width, height, scale, point);
  for (const [name, episode] of [...together].reverse()) {
    const isFirst = name === together[0][0];
    context.globalAlpha = isFirst ? 1 : 0.55;
    drawEpisode(context, episode, name, isFirst && together.length === 1, look, at, scale);
    context.globalAlpha = 1;
  }
  if (side === "side") drawTable(context, width, point); // over the foot, whose capsule reaches below
  for (const [name, episode] of together) drawTool(context, episode, frameAt(episode), name, at);
  canvas.dataset.frame = frameAt(together[0][1]);
}

// Return the box of all postures of the episodes: the image stands still while the arm moves.
function bounds(together, look) {
  const box = [-0.15, 0.6, look.up === 2 ? -0.03 : -0.3, look.up === 2 ? 0.5 : 0.3];
  for (const [, episode] of together) {
    const { values, width } = episode.arrays["view.capsules"];
    const step = Math.max(1, Math.floor(episode.frames / 100)) * width;
    for (let from = 0; from < values.length; from += step) {
      for (let i = from; i < from + width; i += 3) {
        const x = values[i + look.right], y = values[i + look.up];
        if (!Number.isFinite(x + y)) continue;
        box[0] = Math.min(box[0], x - 0.06);
        box[1] = Math.max(box[1], x + 0.06);
        box[2] = Math.min(box[2], y - 0.06);
        box[3] = Math.max(box[3], y + 0.06);
      }
    }
    for (const one of episode.scene?.objects ?? []) {
      const reach = Math.hypot(one.size_x, one.size_y);
      box[1] = Math.max(box[1], one.x + reach);
      if (look.up === 1) {
        box[2] = Math.min(box[2], one.y - reach);
        box[3] = Math.max(box[3], one.y + reach);
      }
    }
  }
  return box;
}

function drawTable(context, width, point) {
  const [, y] = point(0, 0);
  context.fillStyle = colour("--floor");
  context.fillRect(0, y, width, 999);
  context.strokeStyle = colour("--wall");
  context.lineWidth = 1.2;
  polyline(context, [[0, y], [width, y]]);
}

function drawGrid(context, width, height, scale, point) {
  context.strokeStyle = colour("--line");
  context.lineWidth = 1;
  const [x0, y0] = point(0, 0), each = 0.2 * scale;
  for (let x = x0 % each; x < width; x += each) polyline(context, [[x, 0], [x, height]]);
  for (let y = y0 % each; y < height; y += each) polyline(context, [[0, y], [width, y]]);
  context.fillStyle = colour("--muted");
  context.font = "10px system-ui, sans-serif";
  context.fillText("0.2 m squares", 6, height - 6);
}

function drawEpisode(context, episode, name, isAlone, look, at, scale) {
  const frame = frameAt(episode);
  const things = [...limbs(episode, frame, name, isAlone, look, at, scale), ...objects(episode, frame, look, at)];
  things.sort((x, y) => x.depth - y.depth);
  for (const thing of things) thing.draw(context);
  drawTarget(context, episode, frame, at, scale);
}

function limbs(episode, frame, name, isAlone, look, at, scale) {
  const { values, width } = episode.arrays["view.capsules"];
  const edge = colour("--panel"), hands = episode.views.arm.hand;
  const arm = isAlone ? [colour("--limb"), colour("--limb-light")] : [colour(`--${name}`), colour(`--${name}`)];
  const hand = isAlone ? [colour("--hand"), colour("--hand")] : arm;
  return episode.views.arm.radii.map((radius, number) => {
    const from = frame * width + 6 * number;
    const one = values.subarray(from, from + 3), other = values.subarray(from + 3, from + 6);
    const ends = [at(one), at(other)];
    return {
      depth: (look.depth(one) + look.depth(other)) / 2,
      draw: (context) => {
        const across = 2 * radius * scale * 0.72; // slimmer than in the checks, which are generous
        const [own, light] = number >= hands ? hand : arm;
        for (const [hue, wide] of [[edge, across + 1.5], [own, across], [light, 0.4 * across]]) {
          context.strokeStyle = hue;
          context.lineWidth = wide;
          polyline(context, [ends[0], [ends[1][0] + 0.01, ends[1][1]]]); // a line of no length would not be drawn
        }
      },
    };
  });
}

// Return where an object is in a frame: position and quaternion, or null if it is not there.
function place(episode, frame, number) {
  const moved = episode.arrays["view.objects"];
  if (moved) {
    const from = frame * moved.width + 7 * number;
    const values = moved.values.subarray(from, from + 7);
    return Number.isFinite(values[0]) ? [...values] : null;
  }
  const one = episode.scene.objects[number];
  return [one.x, one.y, one.height / 2, Math.cos(one.yaw / 2), 0, 0, Math.sin(one.yaw / 2)];
}

function objects(episode, frame, look, at) {
  return (episode.scene?.objects ?? []).flatMap((one, number) => {
    const pose = place(episode, frame, number);
    if (!pose) return [];
    const outline = hull(surface(one).map((p) => at(moved(p, pose))));
    const [r, g, b] = (episode.scene.colours[one.colour] ?? [0.5, 0.5, 0.5]).map((v) => Math.round(255 * v));
    return [{
      depth: look.depth(pose),
      draw: (context) => {
        context.fillStyle = `rgb(${r} ${g} ${b})`;
        context.strokeStyle = colour("--muted");
        context.lineWidth = 0.8;
        context.beginPath();
        for (const p of outline) context.lineTo(...p);
        context.closePath();
        context.fill();
        context.stroke();
      },
    }];
  });
}

function surface({ kind, size_x: x, size_y: y, height }) {
  const rim = kind === "box"
    ? [[x, y], [-x, y], [-x, -y], [x, -y]]
    : Array.from({ length: 20 }, (_, i) => [x * Math.cos((i * Math.PI) / 10), x * Math.sin((i * Math.PI) / 10)]);
  return rim.flatMap(([i, j]) => [[i, j, height / 2], [i, j, -height / 2]]);
}

function moved([x, y, z], [px, py, pz, w, i, j, k]) {
  return [
    px + (1 - 2 * (j * j + k * k)) * x + 2 * (i * j - k * w) * y + 2 * (i * k + j * w) * z,
    py + 2 * (i * j + k * w) * x + (1 - 2 * (i * i + k * k)) * y + 2 * (j * k - i * w) * z,
    pz + 2 * (i * k - j * w) * x + 2 * (j * k + i * w) * y + (1 - 2 * (i * i + j * j)) * z,
  ];
}

function drawTool(context, episode, now, name, at) {
  const { values } = episode.arrays["view.tool"];
  const step = Math.ceil(episode.frames / 3000); // more points than pixels only take time
  const place = (frame) => at(values.subarray(3 * frame, 3 * frame + 3));
  const way = (last) => [...Array.from({ length: Math.ceil(last / step) }, (_, i) => place(i * step)), place(last)];
  context.strokeStyle = context.fillStyle = colour(`--${name}`);
  context.lineWidth = 1;
  polyline(context, way(episode.frames - 1));
  context.lineWidth = 2.2;
  polyline(context, way(now));
  disc(context, place(now), 3.5);
  context.fill();
}

function drawTarget(context, episode, frame, at, scale) {
  const scene = episode.scene;
  if (!scene) return;
  context.strokeStyle = colour("--text");
  context.lineWidth = 1.3;
  if (Number.isInteger(scene.target_object) && scene.objects[scene.target_object]) {
    const one = scene.objects[scene.target_object], pose = place(episode, frame, scene.target_object);
    if (pose) {
      context.setLineDash([4, 3]);
      disc(context, at(pose), (Math.hypot(one.size_x, one.size_y) + 0.025) * scale);
      context.stroke();
      context.setLineDash([]);
    }
  }
  if (scene.target_pose) {
    const [x, y] = at(scene.target_pose);
    polyline(context, [[x - 7, y], [x + 7, y]]);
    polyline(context, [[x, y - 7], [x, y + 7]]);
  }
}
