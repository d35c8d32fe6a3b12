// Marks: what a person has to say about an episode, written into the dataset.

import { mark } from "./api.js";
import { byId, make, toast } from "./dom.js";
import { outcomeWords } from "./outcomes.js";
import { emit, frameAt, state } from "./store.js";

export function markButtons() {
  const { takes_interventions: takes } = state.dataset;
  return make("div", { class: "marks", role: "group", "aria-label": "Mark the episode" },
    make("span", {}, state.b ? `mark #${state.a.index}` : "mark"),
    make("button", { id: "mark-success", onclick: askSuccess }, "✓ success…"),
    make("button", { id: "mark-failure", onclick: askCause }, "✗ failure…"),
    make("button", {
      id: "mark-intervention", onclick: askRange, disabled: !takes,
      title: takes ? "In which frames somebody else drove" : "The dataset has no column for events",
    }, "intervention…"));
}

async function send(episode, what, words) {
  const buttons = () => document.querySelectorAll(".marks button");
  for (const button of buttons()) button.disabled = true;
  try {
    await mark(episode, what);
    toast(`Episode ${episode.index} ${words}.`);
  } catch (error) {
    toast(error.message, true);
  }
  emit("marked", episode.index); // also where it failed: the dataset may be another one now
}

// Ask in a dialog; `read` turns the form into a mark and the words for it.
function ask(title, fields, read) {
  const dialog = byId("dialog"), episode = state.a;
  const form = make("form", {
    method: "dialog",
    onsubmit: (event) => {
      if (event.submitter?.value === "cancel") return;
      event.preventDefault();
      dialog.close();
      const content = new FormData(form), [what, words] = read(content);
      send(episode, { ...what, note: content.get("note").trim() }, words);
    },
  },
  make("h2", {}, title),
  make("div", { class: "fields" }, ...fields, "note",
    make("input", { name: "note", maxlength: "2000", placeholder: "why; goes into meta/edits.jsonl", "aria-label": "note" })),
  make("p", { class: "explain" }, "The dataset is changed on disk, in one step. What was said before stays in meta/edits.jsonl."),
  make("div", { class: "end" },
    make("button", { value: "cancel", type: "submit", formnovalidate: true }, "Cancel"),
    make("button", { class: "primary", id: "mark-send", type: "submit" }, "Mark")));
  // Enter in a field presses the first submit button: that must not be the one that cancels.
  form.prepend(make("button", { type: "submit", hidden: true, tabindex: "-1" }));
  dialog.replaceChildren(form);
  dialog.showModal();
  form.querySelector("input, select").focus();
}

function askSuccess() {
  ask(`Episode ${state.a.index} was a success`, [], () => [{ outcome: "success" }, "is marked a success"]);
}

function askCause() {
  const causes = state.dataset.outcomes.filter((one) => one !== "success");
  const general = causes.includes("failure") ? "failure" : causes[0];
  const select = make("select", { name: "cause", "aria-label": "cause" },
    ...causes.map((one) => make("option", { value: one, selected: one === general }, one === "failure" ? "no cause named" : outcomeWords(one))));
  ask(`Episode ${state.a.index} was a failure`, ["cause", select], (content) => {
    const cause = content.get("cause");
    return [{ outcome: cause }, `is marked: ${outcomeWords(cause)}`];
  });
}

function askRange() {
  const { frames, interventions } = state.a;
  const number = (name, value) => make("input", {
    name, type: "number", step: "1", min: "0", max: `${frames - 1}`, value: `${value}`, required: true, "aria-label": name,
  });
  const clear = make("input", { type: "checkbox", name: "clear", "aria-label": "take back what is marked so far" });
  const fields = ["first frame", number("first", frameAt(state.a)), "last frame", number("last", frames - 1)];
  if (interventions.length) fields.push("instead of", make("label", {}, clear, ` the ${interventions.length} marked so far`));
  ask(`Somebody else drove in episode ${state.a.index}`, fields, (content) => {
    const span = ["first", "last"].map((name) => Number(content.get(name))).sort((x, y) => x - y);
    return [{ intervention: span, clear_interventions: content.has("clear") }, `has an intervention from frame ${span[0]} to ${span[1]}`];
  });
}
