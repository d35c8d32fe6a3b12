"""The plant of another package, as the cerebellum's process holds it: nothing of it is taken on trust."""

import importlib
import time
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.control.plant import Plant, PlantReading, SafetyStatus
from bhd_lerobot.control.reading_check import ahead_of_time
from bhd_lerobot.errors import ConfigError, PlantLostError, RealtimeError, as_text

_READY_S = 10.0  # that a robot may take until it follows commands: brakes are released, a stop is left
_AGAIN_S = 1.0  # after which a robot that is still stopped is asked again: a datagram is lost, or it asks for a pause
_POLL_S = 0.005
_AHEAD_NS = 1_000_000  # [ns] a stamp may be ahead of now: a millisecond is no other clock
_CALLS = ("open", "enable", "read", "write", "set_mode", "recover", "close")


class Unconnected(Plant):
    """The plant of a host that only mirrors another: it reads and writes nothing."""

    n = 1

    def read(self, out: PlantReading) -> None:
        """Leave `out` as it is."""

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Do nothing."""


def plant_class(name: str) -> Callable[[Any, Any], Plant]:
    """Return the class of a plant.

    Args:
        name: ``"package.module:Class"``.
    """
    module, _, attribute = name.partition(":")
    try:
        found: Any = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever a module raises while it is imported
        reason = as_text(error)
        raise ConfigError(
            f"robot.plant is {name!r}, which cannot be imported: {reason}. Name a class as package.module:Class, of a "
            "module that Python finds: one that is installed, or in a folder of PYTHONPATH."
        ) from error
    missing = [call for call in _CALLS if not callable(getattr(found, call, None))]
    if missing:
        raise ConfigError(
            f"robot.plant is {name!r}, which has no {' and no '.join(missing)}. A subclass of "
            "bhd_lerobot.control.plant.Plant inherits all but read and write."
        )
    return found


class CheckedPlant(Plant):
    """Passes calls on to a plant, and takes what it raises or what is not a number for a fault of the robot.

    Attributes:
        problem: what it raised in the control loop, as text; empty if nothing.
        is_muted: whether commands are dropped, because the loop only warms up.

    Args:
        plant: the plant.
        name: what it is called in messages.
        oldest_ns: a reading that is older than this is none of the present [ns].
        clock: monotonic time [ns].
        sleep: waits for a time [s].
    """

    n = 1

    def __init__(
        self,
        plant: Plant,
        name: str,
        oldest_ns: int,
        clock: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if plant.n != 1:
            raise ConfigError(f"The plant {name} is of n = {plant.n} robots; on the wall clock there is one.")
        self.takes = getattr(plant, "takes", Plant.takes)
        if self.takes not in ("actuators", "twist"):
            raise ConfigError(f"The plant {name} takes {self.takes!r}; what a plant takes is 'actuators' or 'twist'.")
        self.latency_s, self.hint = float(getattr(plant, "latency_s", 0.0)), str(getattr(plant, "hint", ""))
        self._plant, self._name, self._oldest_ns, self._clock, self._sleep = plant, name, oldest_ns, clock, sleep
        self._stamp_ns = np.zeros(1, np.int64)
        self.problem = ""
        self.is_muted = self.is_lost = False

    @classmethod
    def made(cls, name: str, config: Any, body: Any, oldest_ns: int) -> Self:
        """Return a plant, which is not opened yet.

        Args:
            name: of its class.
            config: the robot's configuration.
            body: its hardware.
            oldest_ns: a reading that is older than this is none of the present [ns].

        Raises:
            ConfigError: there is no such class, or it takes no such configuration.
        """
        make = plant_class(name)
        try:
            plant = make(config, body)
        except Exception as error:  # of another package's code
            raise ConfigError(f"The plant {name} cannot be made of this configuration: {as_text(error)}.") from error
        return cls(plant, name, oldest_ns)

    def open(self) -> None:
        """Connect to the robot.

        Raises:
            RealtimeError: that is impossible.
        """
        self._patiently(self._plant.open, "opened")

    def prepare(self, reading: PlantReading) -> None:
        """Make the robot follow commands, and wait until it does; a stop of its own is left as often as it takes.

        Raises:
            RealtimeError: it does not within ten seconds.
        """
        self.problem = ""
        self.read(reading)
        self._leave_a_stop(reading)
        self._patiently(self._plant.enable, "enabled")
        asked = self._clock()
        end = asked + round(_READY_S * 1e9)
        while why := self.not_ready(reading):
            now = self._clock()
            if now > end:
                raise RealtimeError(f"The plant {self._name} is not ready after {_READY_S:g} s: {why}.")
            if now - asked > _AGAIN_S * 1e9 and self._leave_a_stop(reading):
                self._patiently(self._plant.enable, "enabled")
                asked = now
            self._sleep(_POLL_S)
            self.problem = ""  # it may have been over in a moment

    def not_ready(self, reading: PlantReading) -> str:
        """Return as text why the robot cannot be driven now; nothing if it can."""
        self.read(reading)
        age = self._clock() - int(self._stamp_ns[0])
        if self.problem:
            return self.problem
        if self._stamp_ns[0] == 0:
            return "it has read nothing yet, or does not say when (PlantReading.stamp_ns)"
        if age > self._oldest_ns:
            return f"its newest reading is {age / 1e9:.2f} s old"
        if ahead := self._ahead_ns(reading):
            return ahead_of_time(ahead)
        if not all(
            np.isfinite(values).all()
            for values in (reading.position, reading.velocity, reading.effort, reading.sensors)
        ):
            return "it reads what is not a finite number"
        status = int(reading.safety[0])
        named = SafetyStatus(status).name if status in SafetyStatus else f"{status}, which is no SafetyStatus"
        return "" if status == SafetyStatus.NORMAL else f"its safety status is {named}"

    def _leave_a_stop(self, reading: PlantReading) -> bool:
        """Ask the robot to leave a stop of its own; return False if it is in none."""
        if reading.safety[0] == SafetyStatus.NORMAL:
            return False
        self._patiently(self._plant.recover, "recovered")
        return True

    def _patiently(self, call: Callable[[], Any], done: str) -> None:
        try:
            call()
        except Exception as error:  # of another package's code
            raise RealtimeError(f"The plant {self._name} cannot be {done}: {as_text(error)}.") from error

    # --- in the control loop -----------------------------------------------------------------------------------------

    def read(self, out: PlantReading) -> None:
        """Write the newest readings into `out`."""
        out.stamp_ns = self._stamp_ns
        out.safety[:] = SafetyStatus.NORMAL  # if the plant does not say otherwise
        self._try(self._plant.read, out)
        if out.stamp_ns is not self._stamp_ns:
            self._stamp_ns[:] = 0 if out.stamp_ns is None else out.stamp_ns
            out.stamp_ns = self._stamp_ns
        if self.problem or self._ahead_ns(out) or not np.isfinite(out.sensors).all():
            out.safety[:] = SafetyStatus.FAULT

    def _ahead_ns(self, reading: PlantReading) -> int:
        """Return by how much a stamp is from the future, if by more than another clock's resolution [ns]; else 0."""
        newest = int(self._stamp_ns[0])
        if reading.sensors.shape[1]:
            newest = max(newest, int(reading.sensors_ns[0]))
        ahead = newest - self._clock()
        return ahead if ahead > _AHEAD_NS else 0

    def write(self, ctrl: NDArray[np.float64]) -> None:
        """Take actuator commands, shape (1, joints)."""
        if not self.is_muted:
            self._try(self._plant.write, ctrl.copy())

    def set_mode(self, mode: NDArray[np.int8]) -> None:
        """Take the new mode, shape (1,)."""
        if not self.is_muted:
            self._try(self._plant.set_mode, mode.copy())

    def recover(self) -> bool:
        """Begin to leave a stop of the robot's own; return whether the robot may have moved by itself."""
        self.problem = ""
        return bool(self._try(self._plant.recover))

    def close(self) -> None:
        """Disconnect."""
        self._try(self._plant.close)

    def _try(self, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except Exception as error:  # of another package's code: the loop continues, and stops the robot
            self.problem = self.problem or as_text(error)
            self.is_lost |= isinstance(error, PlantLostError)
            return None
