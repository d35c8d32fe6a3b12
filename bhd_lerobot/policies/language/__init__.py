"""From an instruction to a plan of skills."""

__all__ = ["grounding", "instruction", "language_brain", "lexicon"]
