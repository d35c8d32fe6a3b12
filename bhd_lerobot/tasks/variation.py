"""Domain randomisation: how much one episode's world may differ from the next, and from the nominal one."""

import itertools
import math
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

import numpy as np

from bhd_lerobot.bodies.tabletop import MAX_LATENCY_S, Variation, check_camera_error
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.declared import NotNegative, Options, Range

_FIXED = ("camera_error_m", "camera_shift_m", "camera_turn_rad")  # the same in every episode


@dataclass
class RandomisationConfig(Options, prefix="randomisation."):
    """Ranges of domain randomisation, and what is off in every episode. It is recorded with each, in its scene.

    Attributes:
        enabled: whether anything of this is done. Where it is not said, nothing is, and none of the others may be set;
            false switches off what a configuration sets: they are at their defaults then.
        mass: an object's mass is multiplied by up to 1 + this, or divided by it.
        friction: an object's friction is multiplied by up to 1 + this, or divided by it; so is that of the fingers.
        size: an object's measures are multiplied by 1 - this to 1 + this.
        colour: up to this is added to or taken from each of an object's red, green and blue.
        plain: probability that an object lacks what others of its kind have: a cup its handle, a box its tape.
        marked: probability that it has neither of these, but a stripe around it and a patch on its top, light or dark.
        across: probability that a box has its tape across, not along its length.
        surface: up to this is added to or taken from each of the red, green and blue of the table's top.
        light: brightness is multiplied by 1 - this to 1 + this.
        light_direction: up to this is added to x and y of the main light's direction.
        camera_m: up to this is added to each coordinate of the scene camera's position [m].
        camera_rad: both cameras are turned by up to this about each of their axes [rad].
        sensor_noise_rad: noise on observed joint positions has a standard deviation of up to this [rad], on speeds ten
            times that [rad/s].
        latency_s: the servos get their commands up to this late [s].
        latency_min_s: and at least this late; with `latency_s` as large, always [s].
        camera_error_m: added to the positions that the task reports, the same in every episode: x, y, z in the base
            frame, each at most 0.2 [m]. As if the camera that sees target and objects were not where it is taken to be.
        camera_shift_m: added to the scene camera's position, the same in every episode: x, y, z in the base frame [m].
        camera_turn_rad: by what the scene camera is turned, the same in every episode: a rotation vector in its own
            frame, x right, y up, z backwards [rad].
    """

    enabled: bool | None = None
    mass: NotNegative = 0.5
    friction: NotNegative = 0.25
    size: Annotated[float, Range("[0, 1)")] = 0.1
    colour: NotNegative = 0.08
    plain: NotNegative = 0.0
    marked: NotNegative = 0.0
    across: NotNegative = 0.0
    surface: NotNegative = 0.0
    light: Annotated[float, Range("[0, 1)")] = 0.4
    light_direction: NotNegative = 0.3
    camera_m: NotNegative = 0.02
    camera_rad: NotNegative = 0.02
    sensor_noise_rad: NotNegative = 0.0005
    latency_s: Annotated[float, Range(f"[0, {MAX_LATENCY_S}]")] = 0.01
    latency_min_s: NotNegative = 0.0
    camera_error_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    camera_shift_m: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    camera_turn_rad: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def __post_init__(self) -> None:
        super().__post_init__()
        check_camera_error("randomisation.camera_error_m", self.camera_error_m)
        for name, unit in (("camera_shift_m", "m"), ("camera_turn_rad", "rad")):
            values = getattr(self, name)
            if len(values) != 3 or not all(map(math.isfinite, values)):
                raise ConfigError(f"randomisation.{name} is {list(values)}; it must be three finite numbers [{unit}].")
        for name in _FIXED:
            if any(getattr(self, name)) and not self.enabled:
                raise ConfigError(
                    f"randomisation.{name} is {list(getattr(self, name))}, but randomisation.enabled is false, so "
                    "that nothing would be off; set --task.randomisation.enabled=true."
                )
        if self.latency_min_s > self.latency_s:
            raise ConfigError(
                f"randomisation.latency_min_s is {self.latency_min_s}; it must be at most randomisation.latency_s, "
                f"which is {self.latency_s}."
            )
        if self.plain + self.marked + self.across > 1:
            raise ConfigError(
                f"randomisation.plain is {self.plain}, randomisation.marked {self.marked} and randomisation.across "
                f"{self.across}; they are probabilities, together at most 1."
            )
        if not self.enabled:
            self._switch_off()

    def _switch_off(self) -> None:
        """Set ranges to their defaults, or refuse them where nobody said that they are to be off."""
        for one in fields(self):
            value = getattr(self, one.name)
            if one.name in ("enabled", *_FIXED) or value == one.default:
                continue
            if self.enabled is None:
                raise ConfigError(
                    f"randomisation.{one.name} is {value}, but randomisation.enabled is not set, so that nothing "
                    "would vary; set --task.randomisation.enabled=true, or =false if that is what you mean."
                )
            setattr(self, one.name, one.default)  # what is recorded is what was in force
        self.enabled = False


def draw_variation(config: RandomisationConfig, rng: np.random.Generator) -> Variation:
    """Return the world's variation of one episode."""
    if not config.enabled:
        return Variation()
    uniform = rng.uniform
    return Variation(
        light=float(uniform(1 - config.light, 1 + config.light)),
        light_direction=_floats(uniform(-1, 1, 2) * config.light_direction),
        camera_shift=_floats(uniform(-1, 1, 3) * config.camera_m + config.camera_shift_m),
        camera_turn=_floats(uniform(-1, 1, 3) * config.camera_rad + config.camera_turn_rad),
        wrist_turn=_floats(uniform(-1, 1, 3) * config.camera_rad),
        sensor_noise=float(uniform(0, config.sensor_noise_rad)),
        latency_s=float(uniform(config.latency_min_s, config.latency_s)),
        finger_friction=_factor(config.friction, rng),
        camera_error=_floats(config.camera_error_m),
        # Where it is 0, nothing is drawn: worlds stay what they were before this option.
        surface=_floats(uniform(-1, 1, 3) * config.surface) if config.surface > 0 else (0.0, 0.0, 0.0),
    )


def draw_object_changes(config: RandomisationConfig, rng: np.random.Generator) -> dict[str, Any]:
    """Return the factors `mass`, `friction` and `size`, the `shade`, the `style` and the `marks` of one object."""
    looks = {"style": "usual", "marks": ()}
    if not config.enabled:
        return {"mass": 1.0, "friction": 1.0, "size": (1.0, 1.0, 1.0), "shade": (0.0, 0.0, 0.0), **looks}
    changes = {
        "mass": _factor(config.mass, rng),
        "friction": _factor(config.friction, rng),
        "size": _floats(rng.uniform(1 - config.size, 1 + config.size, 3)),
        "shade": _floats(rng.uniform(-1, 1, 3) * config.colour),
    }
    # Where all look as usual, nothing is drawn: worlds stay what they were before these options.
    shares = {"plain": config.plain, "marked": config.marked, "across": config.across}
    if sum(shares.values()) > 0:
        drawn, until = float(rng.random()), itertools.accumulate(shares.values())
        looks["style"] = next((name for name, end in zip(shares, until, strict=True) if drawn < end), "usual")
    if looks["style"] == "marked":
        middle, broad, share = rng.uniform(0.2, 0.8), rng.uniform(0.05, 0.2), rng.uniform(0.3, 0.95)
        looks["marks"] = _floats((middle, broad, rng.uniform(-1, 1), share, rng.uniform(-1, 1)))
    return {**changes, **looks}


def _factor(spread: float, rng: np.random.Generator) -> float:
    """Return a factor between 1 / (1 + spread) and 1 + spread, both ways equally likely."""
    return float((1 + spread) ** rng.uniform(-1, 1))


def _floats(values: Any) -> tuple[Any, ...]:
    return tuple(float(value) for value in values)
