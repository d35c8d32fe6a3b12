// Camera videos, kept at the time of the page. One file holds the videos of many episodes.

import { make } from "./dom.js";
import { frameAt, state } from "./store.js";

const DRIFT_S = 0.12; // a running video that is farther off is put right
const MIME = {
  h264: "video/mp4; codecs=\"avc1.42E01E\"", hevc: "video/mp4; codecs=\"hvc1.1.6.L93.B0\"",
  av1: "video/mp4; codecs=\"av01.0.04M.08\"", vp9: "video/mp4; codecs=\"vp09.00.10.08\"",
};

// Return something with an element and `show()`, which follows the time of the page.
export function cameraView(camera, episode, about) {
  return about.kind === "image" ? images(camera, episode) : video(camera, episode, about);
}

function problemBox() {
  return make("div", { class: "problem", role: "alert", hidden: true });
}

function video(camera, episode, about) {
  const element = make("video", {
    preload: "auto", playsinline: true, "data-camera": camera.key, "aria-label": `camera ${camera.label}`,
    src: `/videos/${encodeURIComponent(camera.key)}/${about.chunk}/${about.file}.mp4`,
  });
  element.muted = true;
  const problem = problemBox();
  let sought = -1; // [s] in the file; what is wanted while an earlier seek is still going on

  element.addEventListener("error", async () => {
    const answer = await fetch(element.src, { method: "HEAD" }).catch(() => null);
    problem.hidden = false;
    if (answer?.status === 404) problem.textContent = "The video's file is missing.";
    else if (MIME[camera.codec] && element.canPlayType(MIME[camera.codec]) === "") {
      problem.textContent = `This browser cannot play ${camera.codec} videos. Another one may: Chrome, Firefox.`;
    } else problem.textContent = `The video (${camera.codec ?? "codec unknown"}) cannot be played: ${element.error?.message || "damaged"}`;
  });
  element.addEventListener("seeked", () => {
    if (sought >= 0 && Math.abs(element.currentTime - sought) > 1e-3 && element.paused) element.currentTime = sought;
  });
  element.addEventListener("loadedmetadata", show);

  function show() {
    const frame = frameAt(episode);
    element.dataset.frame = frame;
    const isOver = state.time >= episode.frames / episode.fps;
    if (state.playing && !isOver) {
      const target = about.from + state.time;
      element.playbackRate = state.rate;
      if (Math.abs(element.currentTime - target) > DRIFT_S * Math.max(1, state.rate)) element.currentTime = target;
      if (element.paused) element.play().catch(() => {}); // it says so itself by its error event
      return;
    }
    if (!element.paused) element.pause();
    sought = about.from + (frame + 0.5) / episode.fps; // the middle of a frame is in no other one
    if (!element.seeking && Math.abs(element.currentTime - sought) > 1e-3) element.currentTime = sought;
  }
  return { element: make("div", { class: "video" }, element, problem), show };
}

function images(camera, episode) {
  const element = make("img", { alt: `camera ${camera.label}`, "data-camera": camera.key });
  const problem = problemBox();
  let isLoading = false, loaded = -1;

  const done = (isFine) => {
    isLoading = false;
    problem.hidden = isFine;
    if (!isFine) problem.textContent = "The image is missing or damaged.";
    show();
  };
  element.addEventListener("load", () => done(true));
  element.addEventListener("error", () => done(false));

  function show() {
    const frame = frameAt(episode);
    if (isLoading || frame === loaded) return; // the newest is asked for when the last one is there
    isLoading = true;
    loaded = frame;
    element.dataset.frame = frame;
    element.src = `/api/episodes/${episode.index}/images/${encodeURIComponent(camera.key)}/${frame}?stamp=${episode.stamp}`;
  }
  return { element: make("div", { class: "video" }, element, problem), show };
}
