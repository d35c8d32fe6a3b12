// Light, dark, or as the system says; remembered by the browser.

import { byId } from "./dom.js";
import { emit } from "./store.js";

const CHOICES = ["system", "light", "dark"];
const system = matchMedia("(prefers-color-scheme: dark)");

function chosen() {
  const stored = localStorage.getItem("bhd-theme");
  return CHOICES.includes(stored) ? stored : "system";
}

function apply() {
  const choice = chosen();
  document.documentElement.dataset.theme = choice === "system" ? (system.matches ? "dark" : "light") : choice;
  byId("theme").textContent = `Theme: ${choice}`;
  emit("theme");
}

export function startTheme() {
  byId("theme").addEventListener("click", () => {
    localStorage.setItem("bhd-theme", CHOICES[(CHOICES.indexOf(chosen()) + 1) % CHOICES.length]);
    apply();
  });
  system.addEventListener("change", apply);
  apply();
}
