"""Where a number is in a message: ``twist.twist.linear.x``, ``position[name=elbow_joint]``, ``ranges``."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError, DatasetError, unknown_name
from bhd_lerobot.ros2.messages.types import ARRAY, BASE, BYTES, NAME, type_store, unknown_type

_STEP = re.compile(r"(?P<name>[A-Za-z]\w*)(?:\[(?:(?P<index>\d+)|(?P<key>[A-Za-z]\w*)=(?P<value>.+))\])?")


@dataclass(frozen=True)
class _Step:
    """A field, and which of its elements.

    Attributes:
        index: of the element; None without one, or where `key` selects it.
        key: the element is the one whose field `key`, or the array `key` beside this one, has the value `value`.
        length: of an array of a fixed length; 0 of any other.
    """

    name: str
    index: int | None
    key: str
    value: str
    is_message: bool
    length: int

    def read(self, message: Any) -> Any:
        found = getattr(message, self.name)
        if self.index is not None:
            if self.index >= len(found):
                raise DatasetError(f"{self.name} has {len(found)} elements; there is no element {self.index}.")
            return found[self.index]
        if not self.key:
            return found
        keys = [getattr(one, self.key) for one in found] if self.is_message else list(getattr(message, self.key))
        if self.value not in keys:
            raise DatasetError(f"{self.key} has no {self.value!r}; it has {', '.join(map(repr, keys)) or 'nothing'}.")
        place = keys.index(self.value)
        if not place < len(found) <= len(keys):
            raise DatasetError(f"{self.name} has {len(found)} elements, and {self.key} has {len(keys)}.")
        return found[place]


@dataclass(frozen=True)
class Field:
    """A field of a type's messages.

    Args:
        path: names separated by dots. ``[2]`` behind a name is an element of an array;
            ``[name=elbow_joint]`` is the one whose field `name` is that, or where the elements are numbers, the one at
            the place of that text in the array `name` beside it.

    Raises:
        ConfigError: the type has no such field.
    """

    msgtype: str
    path: str

    def __post_init__(self) -> None:
        _ = self._resolved

    @property
    def kind(self) -> str:
        """What is there: ``"number"``, ``"array"`` of numbers, or the type of a message."""
        return self._resolved[1]

    @property
    def key(self) -> str:
        """The field by whose value an element is selected, of the last name in the path; empty if none is."""
        return self._resolved[0][-1].key

    def read(self, message: Any) -> Any:
        """Return the value in a deserialised message: a number, an array of them, or a message.

        Raises:
            DatasetError: this message has no such element.
        """
        for step in self._resolved[0]:
            message = step.read(message)
        return message

    def put(self, tree: dict[str, Any], value: float | NDArray[np.float64]) -> None:
        """Set the value in a tree of fields, as `encode` takes it; other elements of an array are 0.

        A whole number, or a truth value, becomes the nearest that its type has.

        Args:
            value: of one message, or where it is a number, of n messages, shape (n,).
        """
        *path, last = self._resolved[0]
        for step in path:
            tree = _child(tree, step)
        values = self._typed(np.atleast_1d(np.asarray(value, np.float64)))
        if last.index is None and not last.key:
            tree[last.name] = values[None] if self.kind == "array" else values
            return
        place = last.index
        if place is None:
            names = tree.setdefault(last.key, [])
            if last.value not in names:
                names.append(last.value)
            place = names.index(last.value)
        numbers = tree.get(last.name, np.zeros((len(values), 0)))
        grown = np.zeros((len(values), max(place + 1, numbers.shape[1])))
        grown[:, : numbers.shape[1]] = numbers
        grown[:, place] = values
        tree[last.name] = grown

    def _typed(self, values: NDArray[np.float64]) -> NDArray[Any]:
        kind = BYTES.get(self._resolved[2], self._resolved[2])
        if kind.startswith("float"):
            return values
        low, high = (0, 1) if kind == "bool" else (int(np.iinfo(kind).min), int(np.iinfo(kind).max))
        return np.array([min(max(round(one), low), high) for one in values.tolist()], kind)

    @cached_property
    def _resolved(self) -> tuple[list[_Step], str, str]:
        """Return the steps, the kind of what they lead to, and the type of its numbers, or of the message."""
        store, inside, steps = type_store(), self.msgtype, []
        if inside not in store.fielddefs:
            raise ConfigError(unknown_type(inside, store.fielddefs))
        parts = re.split(r"\.(?![^\[]*\])", self.path) if self.path else []  # a name in brackets may have dots
        for place, text in enumerate(parts):
            match = _STEP.fullmatch(text)
            if match is None:
                raise ConfigError(f"{text!r} in the field {self.path!r} is no name, name[2] or name[key=value].")
            fields = dict(store.fielddefs[inside][1])
            if match["name"] not in fields:
                raise ConfigError(f"{self.path}: {unknown_name(f'field of {inside}', match['name'], fields)}")
            node = fields[match["name"]]
            is_list = int(node[0]) not in (BASE, NAME)
            selects = match["index"] is not None or match["key"] is not None
            if selects and not is_list:
                raise ConfigError(f"{self.path}: {match['name']} of {inside} is not an array; leave [...] out.")
            element = node[1][0] if is_list else node
            is_message = int(element[0]) == NAME
            if match["key"] is not None:
                beside = dict(store.fielddefs[element[1]][1]) if is_message else fields
                if match["key"] not in beside:
                    owner = element[1] if is_message else inside
                    raise ConfigError(f"{self.path}: {unknown_name(f'field of {owner}', match['key'], beside)}")
            length = node[1][1] if int(node[0]) == ARRAY else 0
            index = None if match["index"] is None else int(match["index"])
            steps.append(_Step(match["name"], index, match["key"] or "", match["value"] or "", is_message, length))
            if place < len(parts) - 1:
                if not is_message or (is_list and not selects):
                    what = "is an array: name an element, as in name[0]" if is_list else "has no fields"
                    raise ConfigError(f"{self.path}: {match['name']} of {inside} {what}.")
                inside = element[1]
            elif not is_message and element[1][0] == "string":
                raise ConfigError(f"{self.path}: {match['name']} of {inside} is text; a feature is a number.")
            elif is_message and is_list and not selects:
                raise ConfigError(
                    f"{self.path}: {match['name']} of {inside} is an array of messages: name one, as in name[0]."
                )
            else:
                kind = element[1] if is_message else "array" if is_list and not selects else "number"
                return steps, kind, element[1] if is_message else element[1][0]
        raise ConfigError(
            f"A field of {self.msgtype} is missing; it has: {', '.join(dict(store.fielddefs[inside][1]))}."
        )


def elements_of(fields: Sequence[Field]) -> dict[str, tuple[set[int], int]]:
    """Return which elements of arrays some fields of one type are in, and how many there have to be, by array.

    An array of a fixed length has all of its elements; any other one those up to the last that is named by its number.
    """
    found: dict[str, tuple[set[int], int]] = {}
    for one in fields:
        path = ""
        for step in one._resolved[0]:
            path += f"{'.' * bool(path)}{step.name}"
            if step.index is not None:
                there, size = found.get(path, (set(), step.length))
                found[path] = ({*there, step.index}, max(size, step.index + 1))
                path += f"[{step.index}]"
            elif step.key:
                path += f"[{step.key}={step.value}]"
    return found


def _child(tree: dict[str, Any], step: _Step) -> dict[str, Any]:
    """Return the tree of a nested message, made where it is missing."""
    if step.index is None and not step.key:
        return tree.setdefault(step.name, {})
    children: list[dict[str, Any]] = tree.setdefault(step.name, [])
    if step.key:
        named = [child for child in children if child.get(step.key) == step.value]
        if not named:
            children.append({step.key: step.value})
        return named[0] if named else children[-1]
    assert step.index is not None
    children.extend({} for _ in range(step.index + 1 - len(children)))
    return children[step.index]
