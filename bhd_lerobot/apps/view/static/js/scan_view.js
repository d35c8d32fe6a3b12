// A laser scan around the robot: ahead is up, left is left.

import { colour, disc, fit, polyline, prepare } from "./canvas.js";
import { frameAt, shown } from "./store.js";

// Return [angle [rad], distance [m]] of every beam in a frame.
export function beams(episode, frame) {
  const { column, first, beams: count } = episode.views.scan;
  const { values, width } = episode.arrays[column];
  return Array.from({ length: count }, (_, beam) => [(2 * Math.PI * beam) / count, values[frame * width + first + beam]]);
}

export function reach(episode) {
  if (episode.views.scan.range_max !== null) return episode.views.scan.range_max;
  let most = 0;
  for (let frame = 0; frame < episode.frames; frame += Math.max(1, Math.floor(episode.frames / 20))) {
    for (const [, distance] of beams(episode, frame)) if (Number.isFinite(distance)) most = Math.max(most, distance);
  }
  return most || 1;
}

export function drawScan(canvas, output) {
  const { context, width, height } = prepare(canvas);
  const scanned = shown().filter(([, episode]) => episode.views.scan);
  const range = Math.max(...scanned.map(([, episode]) => reach(episode)));
  const { scale, point } = fit([-range, range, -range, range], [0, 0, width, height], 12);
  const centre = point(0, 0);
  rings(context, centre, scale, range);
  for (const [name, episode] of [...scanned].reverse()) {
    const frame = frameAt(episode);
    drawOne(context, beams(episode, frame), point, range, colour(`--${name}`));
    if (name === "a") {
      canvas.dataset.frame = frame;
      output.textContent = nearest(beams(episode, frame), range);
    }
  }
  arrow(context, centre);
}

function rings(context, centre, scale, range) {
  context.strokeStyle = colour("--line");
  context.fillStyle = colour("--muted");
  context.lineWidth = 1;
  context.font = "10px system-ui, sans-serif";
  const each = range > 12 ? 5 : range > 6 ? 2 : range > 2 ? 1 : 0.5;
  for (let radius = each; radius <= range + 1e-6; radius += each) {
    disc(context, centre, radius * scale);
    context.stroke();
    context.fillText(`${+radius.toFixed(1)} m`, centre[0] + 3, centre[1] + radius * scale - 3);
  }
  for (const angle of [0, 90, 180, 270]) {
    const turned = (angle * Math.PI) / 180;
    polyline(context, [centre, [centre[0] + range * scale * Math.cos(turned), centre[1] + range * scale * Math.sin(turned)]]);
  }
}

function drawOne(context, scan, point, range, hue) {
  // x ahead is up on the screen, y left is left.
  const place = ([angle, distance]) => point(-distance * Math.sin(angle), distance * Math.cos(angle));
  const seen = scan.filter(([, distance]) => Number.isFinite(distance));
  if (seen.length === 0) return;
  context.beginPath();
  for (const beam of seen) context.lineTo(...place(beam));
  context.closePath();
  context.globalAlpha = 0.13;
  context.fillStyle = hue;
  context.fill();
  context.globalAlpha = 1;
  for (const beam of seen) {
    if (beam[1] >= range - 1e-3) continue; // nothing there
    disc(context, place(beam), 1.6);
    context.fill();
  }
}

function arrow(context, [x, y]) {
  context.fillStyle = colour("--robot");
  context.beginPath();
  context.moveTo(x, y - 8);
  context.lineTo(x + 5.5, y + 6);
  context.lineTo(x, y + 3);
  context.lineTo(x - 5.5, y + 6);
  context.fill();
}

function nearest(scan, range) {
  const seen = scan.filter(([, distance]) => Number.isFinite(distance));
  if (seen.length === 0) return "no beam has a value";
  const [angle, distance] = seen.reduce((x, y) => (y[1] < x[1] ? y : x));
  if (distance >= range - 1e-3) return "nothing in reach";
  const degrees = Math.round((angle * 180) / Math.PI);
  const side = degrees === 0 || degrees === 180 ? "" : degrees < 180 ? " left" : " right";
  return `nearest ${distance.toFixed(2)} m, ${degrees > 180 ? 360 - degrees : degrees}°${side}`;
}
