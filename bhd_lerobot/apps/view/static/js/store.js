// What the page shows at the moment, and who wants to hear about changes of it.

export const state = {
  dataset: null, // what /api/dataset says
  a: null, // the selected episode, as `loadEpisode` returns it
  aimed: null, // number of the episode that is being loaded, or is: keys may be faster than the disk
  b: null, // the one that it is compared with
  time: 0, // [s] since the start of both
  playing: false,
  rate: 1,
};

const listeners = new Map();

export function on(event, listener) {
  if (!listeners.has(event)) listeners.set(event, []);
  listeners.get(event).push(listener);
}

export function emit(event, detail) {
  for (const listener of listeners.get(event) ?? []) listener(detail);
}

// The episodes that are shown: one or two, each with the name of its colour.
export function shown() {
  return [["a", state.a], ["b", state.b]].filter(([, episode]) => episode !== null);
}

export function duration() {
  return Math.max(0, ...shown().map(([, episode]) => episode.frames / episode.fps));
}

export function frameAt(episode, time = state.time) {
  return Math.min(episode.frames - 1, Math.max(0, Math.floor(time * episode.fps + 1e-6)));
}

// Return [first frame, frame after the last] of every run of values that are not zero.
export function segments(values = []) {
  const found = [];
  values.forEach((value, frame) => {
    if (!value) return;
    if (found.at(-1)?.[1] === frame) found.at(-1)[1] = frame + 1;
    else found.push([frame, frame + 1]);
  });
  return found;
}
