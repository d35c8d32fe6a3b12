// The time that everything shows: sought by hand, or running.

import { duration, emit, on, state } from "./store.js";

let last = 0;

export function seek(time) {
  state.time = Math.min(Math.max(0, time), duration());
  emit("time");
}

export function step(frames) {
  pause();
  const fps = state.a.fps;
  seek((Math.min(Math.floor(state.time * fps + 1e-6), state.a.frames - 1) + frames) / fps);
}

export function play() {
  if (!state.a) return;
  if (state.time >= duration() - 1e-9) state.time = 0;
  state.playing = true;
  last = performance.now();
  requestAnimationFrame(tick);
  emit("playing");
}

export function pause() {
  if (!state.playing) return;
  state.playing = false;
  emit("playing");
  emit("time"); // videos go to the exact frame
}

export function setRate(rate) {
  state.rate = rate;
  emit("playing");
}

function tick(now) {
  if (!state.playing) return;
  state.time += (Math.max(0, now - last) / 1000) * state.rate;
  last = now;
  if (state.time >= duration()) {
    state.time = duration();
    pause();
    return;
  }
  emit("time");
  requestAnimationFrame(tick);
}

on("episodes", () => {
  state.time = Math.min(state.time, duration());
});
