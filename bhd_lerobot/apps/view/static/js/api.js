// Everything that is asked of the server.

const token = document.querySelector("meta[name=bhd-token]").content;
const KEPT = 24; // episodes in memory: enough to go back and forth
const episodes = new Map(); // number and stamp -> promise of an episode

async function ask(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new Error("The server does not answer. Was it ended? Start bhd-data view again.");
  }
  if (response.ok) return response;
  const text = await response.text();
  let message = text.trim() || `${path}: status ${response.status}`;
  try {
    message = JSON.parse(text).error ?? message;
  } catch { /* plain text says it */ }
  throw new Error(message);
}

export async function loadDataset() {
  return (await ask("/api/dataset")).json();
}

export async function loadStamp() {
  return (await ask("/api/stamp")).json();
}

export function loadEpisode(index, stamp) {
  const key = `${index} ${stamp}`;
  const known = episodes.get(key) ?? ask(`/api/episodes/${index}?stamp=${stamp}`)
    .then((response) => response.arrayBuffer()).then((buffer) => ({ ...unpack(buffer), stamp }));
  episodes.delete(key);
  episodes.set(key, known); // the newest is last
  if (episodes.size > KEPT) episodes.delete(episodes.keys().next().value);
  known.catch(() => episodes.delete(key));
  return known;
}

// Once the dataset has changed, the number may be another episode's: the stamp says which dataset is shown.
export async function mark({ index, stamp }, what) {
  const headers = { "Content-Type": "application/json", "X-Bhd-Token": token };
  return (await ask(`/api/episodes/${index}/mark?stamp=${stamp}`, { method: "POST", headers, body: JSON.stringify(what) })).json();
}

const TYPES = { float32: Float32Array, float64: Float64Array, uint8: Uint8Array, int32: Int32Array };

// The layout is described in packing.py: magic, length of the header, header, arrays.
export function unpack(buffer) {
  const view = new DataView(buffer);
  if (view.getUint32(0, false) !== 0x42484456) throw new Error("The server sent something else than an episode.");
  const length = view.getUint32(4, true);
  const episode = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  for (const [name, about] of Object.entries(episode.arrays)) {
    const count = about.shape.reduce((x, y) => x * y, 1);
    about.values = new TYPES[about.dtype](buffer, 8 + length + about.offset, count);
    about.width = about.shape.slice(1).reduce((x, y) => x * y, 1);
    about.name = name;
  }
  return episode;
}
