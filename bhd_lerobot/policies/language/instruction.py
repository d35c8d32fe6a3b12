"""Instructions in English and Chinese, understood by rules: one action, one object, and every word accounted for."""

import itertools
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from bhd_lerobot.bodies.tabletop import COLOURS, KINDS
from bhd_lerobot.errors import ConfigError, InstructionError, NothingFitsError
from bhd_lerobot.policies.language.grounding import Description, descriptions, fitting
from bhd_lerobot.policies.language.lexicon import ANYTHING, CHINESE, ENGLISH, VERBS, Language, Part, Relation
from bhd_lerobot.policies.manipulation.skills import Plan, SceneObject, Skill, check_request, make_plan

MAX_LENGTH = 200  # characters; far more than the longest sentence of this grammar
SKILLS = {
    Skill.HOLD: (Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT, Skill.HOLD),
    Skill.HAND_OVER: (Skill.LOCATE, Skill.APPROACH, Skill.GRASP, Skill.LIFT, Skill.HAND_OVER),
}


@dataclass(frozen=True)
class Request:
    """What an instruction asks for."""

    goal: Skill
    what: Description
    language: Language


class RulePlanner:
    """Plans for instructions that `parse` understands and that fit exactly one object on the table."""

    def plan(self, instruction: str, scene: Sequence[SceneObject]) -> Plan:
        """Return the plan for an instruction."""
        objects = list(check_request(instruction, scene).values())
        request = parse(instruction)
        found = fitting(request.what, objects)
        if len(found) == 1:
            return make_plan(instruction, found[0], SKILLS[request.goal])
        phrase = _phrases(request.what, request.language)[0]
        name = describe if request.language is ENGLISH else chinese
        if not found:
            there = ", ".join(name(thing) for thing in objects) or "(nothing)"
            raise NothingFitsError(f"Nothing on the table is '{phrase}'. On the table: {there}.")
        exact = [_instructions(objects, thing, request.language, request.goal) for thing in found]
        advice = ", ".join(repr(each[0]) for each in exact if each)
        raise InstructionError(
            f"'{phrase}' fits {len(found)} objects: {', '.join(map(name, found))}. "
            + (f"Say one of: {advice}." if advice else "No known words distinguish them; move one of them.")
        )


# --- understanding ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Token:
    text: str
    part: Part
    value: str = ""


def parse(instruction: str) -> Request:
    """Return what an instruction asks for."""
    if len(instruction) > MAX_LENGTH:
        raise InstructionError(
            f"The instruction has {len(instruction)} characters; at most {MAX_LENGTH} are understood."
        )
    text = unicodedata.normalize("NFKC", instruction).casefold().translate(_APOSTROPHES)
    text = "".join(c for c in text if unicodedata.category(c) != "Cf")  # invisible ones, which pasted text may contain
    is_chinese = re.search("[\u4e00-\u9fff]", text) is not None
    language = CHINESE if is_chinese else ENGLISH
    tokens = _tokens(_chunks(text, is_chinese), language, "" if is_chinese else " ")
    parts = "".join(token.part for token in tokens)
    if language.give.fullmatch(parts):
        goal = Skill.HAND_OVER
    elif language.lift.fullmatch(parts):
        goal = Skill.HOLD
    else:
        raise InstructionError(f"{instruction!r} is not understood. {_reason(tokens, parts, language)}")
    kind = _only([t for t in tokens if t.part is Part.NOUN], "thing", instruction)
    colour = _only([t for t in tokens if t.part is Part.COLOUR], "colour", instruction)
    places = (Part.WHICH, Part.WHERE, Part.ASIDE)
    relation = _only([t for t in tokens if t.part in places], "place or size", instruction)
    what = Description(None if kind == ANYTHING else kind, colour, Relation(relation) if relation else None)
    return Request(goal, what, language)


_APOSTROPHES = {ord(mark): "'" for mark in "\u2018\u2019\u02bc`"}
_PUNCTUATION = frozenset(".,!?;:\"'()[]\u2026\u3002\u3001\u201c\u201d\u300c\u300d\u300a\u300b")


def _chunks(text: str, is_chinese: bool) -> list[list[str]]:
    """Return the words, or for Chinese the characters, between punctuation marks; no phrase reaches across a mark."""
    # Whatever is neither a word nor a blank is kept as a word of its own: "/" or "&" must not vanish.
    pattern = r"\S" if is_chinese else r"[^\W_]+(?:['-][^\W_]+)*|\S"
    groups = itertools.groupby(re.findall(pattern, text), key=_PUNCTUATION.__contains__)
    return [list(words) for is_mark, words in groups if not is_mark]


def _tokens(chunks: list[list[str]], language: Language, blank: str) -> list[_Token]:
    """Return the longest known phrases from left to right; unknown words in a row are one token."""
    longest = max(len(phrase.split(blank) if blank else phrase) for phrase in language.words)
    tokens: list[_Token] = []
    for words in chunks:
        start = 0
        while start < len(words):
            for stop in range(min(len(words), start + longest), start, -1):
                phrase = blank.join(words[start:stop])
                if phrase in language.words:
                    tokens.append(_Token(phrase, *language.words[phrase]))
                    break
            else:
                stop = start + 1
                before = [tokens.pop().text] if tokens and tokens[-1].part is Part.UNKNOWN else []
                tokens.append(_Token(blank.join([*before, words[start]]), Part.UNKNOWN))
            start = stop
    return tokens


def _only(tokens: list[_Token], what: str, instruction: str) -> str | None:
    """Return the value that all tokens share, or None if there are none."""
    values = {token.value for token in tokens}
    if len(values) > 1:
        named = ", ".join(repr(token.text) for token in tokens)
        raise InstructionError(f"{instruction!r} is not understood. It names more than one {what}: {named}.")
    return values.pop() if values else None


def _reason(tokens: list[_Token], parts: str, language: Language) -> str:
    """Return why parts match no pattern."""
    named = {part: ", ".join(repr(token.text) for token in tokens if token.part is part) for part in Part}
    verbs = [repr(token.text) for token in tokens if token.part in VERBS]
    example = f"Say for example {language.example!r}."
    if named[Part.NOT]:
        reason = f"Negations are not known: {named[Part.NOT]}. Say what is wanted. {example}"
    elif named[Part.SEVERAL]:
        reason = f"Only one action with one object can be asked for, not with {named[Part.SEVERAL]}. {example}"
    elif named[Part.UNKNOWN]:
        reason = _unknown(tokens, parts, language)
    elif not verbs and not named[Part.TO_ME]:
        reason = f"It names no action. Known: {language.verbs}."
    elif len(verbs) > 1:
        reason = f"It names more than one action: {', '.join(verbs)}. {example}"
    elif not named[Part.NOUN]:
        reason = f"It names no thing. Known: {language.listing(KINDS)}."
    elif parts.count(Part.NOUN) > 1:
        reason = f"It names more than one thing: {named[Part.NOUN]}. {example}"
    elif named[Part.ASIDE]:
        reason = f"{named[Part.ASIDE]} may be where it stands or where it is to go. Say 'on the …' for where it stands."
    else:
        reason = f"The order of its words is not known. {example}"
    return reason


def _unknown(tokens: list[_Token], parts: str, language: Language) -> str:
    """Return what an unknown word was probably meant to be: what would make the sentence right."""
    unknown = [token.text for token in tokens if token.part is Part.UNKNOWN]
    colours, relations = language.listing(COLOURS), language.listing(Relation)
    known = {
        Part.LIFT: ("action", language.verbs),
        Part.NOUN: ("thing", language.listing(KINDS)),
        Part.COLOUR: ("colour or property", f"{colours}; {relations}"),
    }
    if len(unknown) <= 3:  # else there are too many ways to read it
        for guess in itertools.product(known, repeat=len(unknown)):
            letters = iter(guess)
            read = "".join(next(letters) if part == Part.UNKNOWN else part for part in parts)
            if language.lift.fullmatch(read) or language.give.fullmatch(read):
                return " ".join(
                    f"Unknown {known[part][0]} {text!r}. Known: {known[part][1]}."
                    for part, text in zip(guess, unknown, strict=True)
                )
    words = ", ".join(map(repr, unknown))
    return f"Unknown: {words}. Say for example {language.example!r}."


# --- saying ----------------------------------------------------------------------------------------------------------

_AFTER_NOUN = {Relation.LEFT: "on the left", Relation.RIGHT: "on the right"}
_TEMPLATES: dict[tuple[str, Skill], tuple[str, ...]] = {
    ("en", Skill.HOLD): ("pick up {}", "grab {}", "please lift {}"),
    ("en", Skill.HAND_OVER): ("hand me {}", "give me {}", "please bring {} to me"),
    ("zh", Skill.HOLD): ("拿起{}", "抓住{}", "请把{}拿起来"),
    ("zh", Skill.HAND_OVER): ("把{}递给我", "给我{}", "请把桌上的{}拿给我"),
}
LANGUAGES = {"en": ENGLISH, "zh": CHINESE}


def describe(thing: SceneObject) -> str:
    """Return the English name of an object, for example ``"red cup"``."""
    return thing.name


def chinese(thing: SceneObject) -> str:
    """Return the Chinese name of an object, for example ``"红色杯子"``."""
    return CHINESE.names[thing.colour] + CHINESE.names[thing.kind]


def instructions_for(
    scene: Sequence[SceneObject], target: int, language: str | None = None, goal: Skill | None = None
) -> tuple[str, ...]:
    """Return instructions that mean one object of a scene and no other, the plainest first.

    There are none if no known words distinguish the object from another one.

    The language is ``"en"`` or ``"zh"``, the goal `Skill.HOLD` or `Skill.HAND_OVER`; None: both.
    """
    objects = {thing.index: thing for thing in scene}
    if target not in objects:
        raise ConfigError(f"target is {target!r}; the scene has objects {sorted(objects)}.")
    if language not in (None, *LANGUAGES):
        raise ConfigError(f"language is {language!r}; valid: {', '.join(LANGUAGES)}, or None for both.")
    if goal not in (None, *SKILLS):
        raise ConfigError(f"goal is {goal!r}; valid: {', '.join(SKILLS)}, or None for both.")
    chosen = [LANGUAGES[language]] if language else list(LANGUAGES.values())
    goals = [goal] if goal else list(SKILLS)
    return tuple(s for each in chosen for g in goals for s in _instructions(scene, objects[target], each, g))


def _instructions(scene: Sequence[SceneObject], target: SceneObject, language: Language, goal: Skill) -> list[str]:
    phrases = [phrase for what in descriptions(scene, target) for phrase in _phrases(what, language)]
    if language is ENGLISH:
        phrases = [f"the {phrase}" for phrase in phrases]
    code = "en" if language is ENGLISH else "zh"
    return [template.format(phrase) for phrase in phrases for template in _TEMPLATES[code, goal]]


def _phrases(what: Description, language: Language) -> list[str]:
    """Return the ways to say a description."""
    relation, names = what.relation, language.names
    noun = names[what.kind or ANYTHING]
    if language is CHINESE:
        colour = names[what.colour] if what.colour else ""
        return [(f"{names[relation]}的" if relation else "") + colour + noun]
    noun = f"{names[what.colour]} {noun}" if what.colour else noun
    if relation is None:
        return [noun]
    after = [f"{noun} {_AFTER_NOUN[relation]}"] if relation in _AFTER_NOUN else []
    return [*after, f"{names[relation]} {noun}"]
