// How an episode ended: its colour and its words. The word is always beside the colour.

const COLOURS = {
  "": "--muted", success: "--good", timeout: "--warn", stuck: "--warn", wrong_object: "--odd", unreachable: "--odd",
};

export function outcomeColour(outcome) {
  return `var(${COLOURS[outcome] ?? "--bad"})`;
}

export function outcomeWords(outcome) {
  return outcome === "" ? "not judged" : outcome.replaceAll("_", " ");
}
