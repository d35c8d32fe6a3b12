// Puts the page together: loads the dataset, selects episodes, watches for changes on disk.

import { startAbout } from "./about.js";
import { loadDataset, loadEpisode, loadStamp } from "./api.js";
import { seek } from "./clock.js";
import { byId, toast } from "./dom.js";
import { neighbour, scrollTo, startList } from "./episode_list.js";
import { startKeys } from "./keys.js";
import { startPlots } from "./plots.js";
import { emit, on, state } from "./store.js";
import { startTheme } from "./theme.js";
import { startTimeline } from "./timeline.js";
import { startViews } from "./views.js";

const PAUSE_MS = 80;
const LOOK_MS = 2000; // between two looks at whether the dataset has changed
let before = null; // the episode that was selected before this one
let refusal = null; // why the changed dataset could not be read
let loading = 0; // requests that are under way
let wanted = 0; // number of the newest request, so that a slow answer does not replace a newer one

async function select(index, { compare = undefined, time = 0 } = {}) {
  if (index === undefined || index >= state.dataset.episodes.frames.length) return;
  const mine = ++wanted;
  state.aimed = index;
  emit("aimed");
  scrollTo(index);
  if (loading > 0) await new Promise((done) => setTimeout(done, PAUSE_MS)); // a key that is held down loads the last one
  if (mine !== wanted) return;
  loading++;
  const other = compare === undefined ? state.b?.index ?? null : compare;
  try {
    const { stamp } = state.dataset;
    const [a, b] = await Promise.all([loadEpisode(index, stamp), other === null || other === index ? null : loadEpisode(other, stamp)]);
    if (mine !== wanted) return;
    if (state.a && state.a.index !== index) before = state.a.index;
    state.a = a;
    state.b = b;
    state.time = time;
    emit("episodes");
    seek(time);
    remember();
    preload(stamp);
  } catch (error) {
    toast(error.message, true);
    if (mine !== wanted) return;
    state.aimed = state.a?.index ?? null;
    emit("aimed");
  } finally {
    loading--;
  }
}

// What comes next is there when it is asked for.
function preload(stamp) {
  const next = neighbour(1);
  if (next !== undefined && next !== state.aimed) loadEpisode(next, stamp).catch(() => {});
}

// On a narrow screen the list covers the episode, until one is chosen.
function showList(isShown) {
  document.body.classList.toggle("listed", isShown);
  byId("episodes-button").setAttribute("aria-expanded", `${isShown}`);
}

function choose(index, isCompared) {
  showList(false);
  if (isCompared && state.a && state.a.index !== index) select(state.a.index, { compare: index, time: state.time });
  else select(index);
}

function toggleCompare() {
  if (state.b) return endCompare();
  const count = state.dataset.episodes.frames.length;
  const other = before !== null && before !== state.a.index && before < count ? before : neighbour(neighbour(1) === state.aimed ? -1 : 1);
  if (other === state.a.index) return toast("There is no other episode to compare with.");
  select(state.a.index, { compare: other, time: state.time });
}

function endCompare() {
  select(state.a.index, { compare: null, time: state.time });
}

// The address names what is shown, so that it can be kept or told.
function remember() {
  const parts = new URLSearchParams({ episode: state.a.index });
  if (state.b) parts.set("compare", state.b.index);
  history.replaceState(null, "", `#${parts}`);
}

function told() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const number = (name) => (/^\d+$/.test(parts.get(name) ?? "") ? Number(parts.get(name)) : null);
  const count = state.dataset.episodes.frames.length;
  const inside = (value) => {
    if (value !== null && value >= count) toast(`There is no episode ${value}: the dataset has ${count}, from 0 to ${count - 1}.`, true);
    return value !== null && value < count ? value : null;
  };
  for (const name of ["episode", "compare"]) {
    if (parts.has(name) && number(name) === null) toast(`The address names ${name} ${parts.get(name)}, which is no number of an episode.`, true);
  }
  const time = Number.parseFloat(parts.get("t") ?? "0");
  return { episode: inside(number("episode")) ?? 0, compare: inside(number("compare")), time: Number.isFinite(time) ? time : 0 };
}

async function load() {
  state.dataset = await loadDataset();
  refusal = null;
  const { name, root, robot, fps, frames, episodes, unfinished } = state.dataset;
  document.title = `${name} – bhd-data view`;
  byId("dataset-name").textContent = name;
  byId("dataset-name").title = root;
  const hours = frames / fps >= 3600 ? `${(frames / fps / 3600).toFixed(1)} h` : `${(frames / fps).toFixed(0)} s`;
  byId("dataset-about").textContent = `${robot ?? "unknown robot"} · ${fps} frames/s · ${episodes.frames.length} episodes · ${frames} frames, ${hours}`;
  banner(unfinished ? "The recording was interrupted and is not finalised; bhd-data repair finishes it." : null);
  emit("dataset");
  const isEmpty = episodes.frames.length === 0;
  byId("nothing").hidden = !isEmpty;
  byId("nothing").textContent = "The dataset has no episodes yet.";
  for (const id of ["about", "views", "timeline", "plots"]) byId(id).hidden = isEmpty;
}

async function reload() {
  try {
    await load();
    const { a, b, time } = state, count = state.dataset.episodes.frames.length;
    if (!a) return count ? select(0) : undefined;
    await select(Math.min(a.index, count - 1), { compare: b && b.index < count ? b.index : null, time });
  } catch (error) {
    refusal = error.message;
    banner(refusal, true);
  }
}

function banner(text, canReload = false) {
  if (text !== null && text === byId("banner").querySelector("span").textContent) return; // said once is enough
  byId("banner").hidden = text === null;
  byId("banner").querySelector("span").textContent = text ?? "";
  byId("banner").querySelector("button").hidden = !canReload;
}

async function look() {
  try {
    const { now } = await loadStamp();
    if (now !== state.dataset.stamp) banner(refusal ?? "The dataset has changed on disk.", true);
    else if (byId("banner").querySelector("span").textContent.startsWith("The server does not")) banner(null);
  } catch (error) {
    banner(error.message);
  }
  setTimeout(look, LOOK_MS);
}

async function start() {
  startTheme();
  startList(choose);
  startAbout(endCompare);
  startViews();
  startTimeline();
  startPlots();
  byId("episodes-button").addEventListener("click", () => showList(document.body.classList.contains("listed") === false));
  addEventListener("hashchange", () => {
    const { episode, compare, time } = told();
    if (state.dataset.episodes.frames.length && (episode !== state.a?.index || compare !== (state.b?.index ?? null))) select(episode, { compare, time });
  });
  startKeys({ move: (rows) => select(neighbour(rows)), compare: toggleCompare });
  byId("banner").querySelector("button").addEventListener("click", reload);
  on("marked", reload);
  try {
    await load();
  } catch (error) {
    return banner(error.message, true);
  }
  const { episode, compare, time } = told();
  if (state.dataset.episodes.frames.length) await select(episode, { compare, time });
  document.body.dataset.ready = "yes";
  setTimeout(look, LOOK_MS);
}

start();
