"""n robots under one cerebellum: what a LeRobot `Robot`, the batched runs and a real robot are all made of."""

import re
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Body, without_jerk_limits
from bhd_lerobot.bodies.truth import truth_of
from bhd_lerobot.control.bridge import LockstepBridge
from bhd_lerobot.control.cerebellum import Cerebellum
from bhd_lerobot.control.commands import BrainCommand, Chunk, Command, Goals
from bhd_lerobot.control.controller import Controller
from bhd_lerobot.control.messages import NANOSECONDS, Limit, Reason, SendResult
from bhd_lerobot.control.motion.planning import Planning
from bhd_lerobot.control.plant import Plant, PlantReading
from bhd_lerobot.control.record import command_age_ns
from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.robots.host.robots import Acceptance, ActionReport, Clock, Deliver, Frame, FrameReport
from bhd_lerobot.robots.parts.part import Part, Refused


class Host:
    """n robots of one kind: what they observe, how they act, goals and modes. It needs no world.

    Each is in an episode of its own, which nothing outside it can change: not the number of the others, not what they
    do. What is observed, and how they act, say its parts; a simulation adds a world, see `Simulation`.

    Args:
        config: the robot's configuration, which says its body.
        plant: what moves it.
        planning: who plans goals; they are planned in the tick that they start in if None.
        camera_names: the cameras that are observed.

    Attributes:
        n: how many robots.
        rates: the rates.
        body: the robot's hardware.
        parts: its arm and its drive, as far as it has them.
        cerebellum: what controls the robots.
        bridge: how commands get to the cerebellum.
        action_names: names of the action's floats, in order.
        observation_names: names of the observation's floats, in order.
        sensed_names: those that do not follow from others.
        running: which robots are in an episode, shape (n,).
        tick: control ticks that have gone by.
        world: the simulated world, which can be placed, stored and rendered; None of a real robot.
        clock: None: time advances with `step`.
        knows: the fields of a task's truth that the robots measure themselves; None if there is a world, of which all
            is known.
        sensor_period_s: time between two readings of the slowest sensor [s]; 0 if all are read at every tick.
    """

    world: Any = None
    clock: Clock | None = None

    def __init__(
        self, config: Any, plant: Plant, planning: Planning | None = None, *, camera_names: Sequence[str] = ()
    ) -> None:
        self.config, self.plant, self.rates = config, plant, config.rates
        self.n = n = plant.n
        body: Body = config.body()
        self.body = body = body if config.jerk_limits else without_jerk_limits(body)
        self.parts: list[Part] = self._make_parts(planning)
        sensors = sum(part.sensors for part in self.parts)
        self.cerebellum = Cerebellum(body, plant, config.control_hz, _one(self.parts), sensors=sensors)
        self.bridge = LockstepBridge(self.cerebellum, self.rates, self.advance, self.run_ticks)
        self.action_names = tuple(name for part in self.parts for name in part.action_names)
        self.observation_names = tuple(name for part in self.parts for name in part.observation_names)
        self.camera_names = tuple(camera_names)
        known = [part.knows for part in self.parts]
        self.knows: frozenset[str] | None = known[0].union(*known[1:]) if self.world is None else None
        self.sensor_period_s = max(part.sensor_period_s for part in self.parts)
        for part in self.parts:
            part.host = self
        sensed = [part.observation_names[: len(part.observation_names) - part.derived] for part in self.parts]
        self.sensed_names = tuple(name for names in sensed for name in names)
        self._observed, self._sensed, self._actions, self._commands = (
            _places(widths)
            for widths in (
                [len(part.observation_names) for part in self.parts],
                [len(names) for names in sensed],
                [len(part.action_names) for part in self.parts],
                [part.controller.width for part in self.parts],
            )
        )
        self._has_wrench = bool(getattr(config, "wrench", False))
        self.running = np.ones(n, np.bool_)
        self.tick = 0
        self._start_tick = np.zeros(n, np.int64)
        self._no_physics = np.zeros((n, 0)), np.zeros((n, 0))

    def _make_parts(self, planning: Planning | None) -> list[Any]:
        """Return the parts of the body: the arm's commands come before the drive's."""
        parts: list[Part] = []
        if self.body.arm is not None:
            from bhd_lerobot.robots.parts.arm import ArmPart  # imports Pinocchio, which a base does without

            parts.append(ArmPart(self.config, self.body, self.plant, planning))
        if self.body.drive is not None:
            from bhd_lerobot.robots.parts.drive import DrivePart

            arm = parts[0].controller if parts else None
            parts.append(DrivePart(self.config, self.body, self.plant, arm))
        return parts

    @property
    def controller(self) -> Any:
        """What turns commands into actuator commands."""
        return self.cerebellum.controller

    @property
    def kinematics(self) -> Any:
        """The arm's kinematics, an `ArmKinematics`."""
        return self._part("kinematics").kinematics

    def _part(self, name: str) -> Any:
        """Return the part that has something.

        Raises:
            ConfigError: none has it.
        """
        for part in self.parts:
            if hasattr(part, name):
                return part
        raise ConfigError(f"The robot {self.body.name!r} has no {name}.")

    @property
    def camera_shapes(self) -> dict[str, tuple[int, int, int]]:
        """Image shapes (height, width, channels) [px] of the cameras that are observed, by name."""
        return dict.fromkeys(self.camera_names, (self.config.camera_height, self.config.camera_width, 3))

    # --- what its parts say ------------------------------------------------------------------------------------------

    def read(self) -> PlantReading:
        """Return the newest reading of the joints."""
        return self.cerebellum.reading

    def sense(self, out: NDArray[np.float64] | None = None) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return what is sensed, shape (n, `sensed_names`), and the tick of the oldest reading, shape (n,).

        Args:
            out: where the floats are written; a new array if None.
        """
        out = np.empty((self.n, len(self.sensed_names))) if out is None else out
        reading = self.read()
        for part, columns in zip(self.parts, self._sensed, strict=True):
            part.sense(reading, out[:, columns])
        oldest = [part.oldest() for part in self.parts]
        return out, oldest[0] if len(oldest) == 1 else np.minimum.reduce(oldest)

    def completed(self, sensed: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the observation's floats, shape (n, features), from what is sensed."""
        if len(self.sensed_names) == len(self.observation_names):
            return sensed
        out = np.empty((len(sensed), len(self.observation_names)))
        for part, columns, ours in zip(self.parts, self._observed, self._sensed, strict=True):
            values = out[:, columns]
            values[:, : ours.stop - ours.start] = sensed[:, ours]
            part.derive(values)
        return out

    def truth(self) -> Any:
        """Return what a task judges by, as far as it is known; touches since the start of the last frame."""
        reading = self.read()
        return truth_of({name: value for part in self.parts for name, value in part.truth(reading).items()})

    def track(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the robot was in recorded states, shape (frames, 7); see `Robots.track`."""
        return self.parts[-1].track(states)

    @property
    def touches(self) -> tuple[NDArray[np.bool_], ...]:
        """What was touched since the start of the last frame, by kind, live, each of shape (n,)."""
        return ()

    def place(self, ids: NDArray[np.intp], scenes: Sequence[Any]) -> None:
        """Take over what is known of the scenes that robots are in; a simulation puts them there."""
        for part in self.parts:
            part.place(ids, scenes)

    def start_goal(self, scene: Any) -> BrainCommand | None:
        """Return the goal that brings a robot without a world to the start of a scene; None if a person does that."""
        return next((goal for part in self.parts if (goal := part.start_goal(scene)) is not None), None)

    def show(self, row: Any) -> None:
        """Take over what the process of a robot on the wall clock published beside its record."""
        return

    def to_action(self, command: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return commands of the cerebellum, shape (n, width), in the space of the actions, shape (n, actions)."""
        if len(self.parts) == 1:
            return self.parts[0].to_action(command)
        pairs = zip(self.parts, self._commands, strict=True)
        return np.concatenate([part.to_action(command[:, columns]) for part, columns in pairs], axis=1)

    def to_setpoints(
        self, action: NDArray[np.float64], mask: NDArray[np.bool_], before: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], Refused]:
        """Turn actions into setpoints of the cerebellum, shape (n, width), and say which cannot be, and why.

        Args:
            action: shape (n, actions).
            mask: the robots that they are for, shape (n,).
            before: the setpoints before these, shape (n, width); the present commands if None.
        """
        before = self.cerebellum.command if before is None else before
        if len(self.parts) == 1:
            return self.parts[0].to_setpoints(action, mask, before)
        made, refused = [], {}
        for part, ours, columns in zip(self.parts, self._actions, self._commands, strict=True):
            setpoints, problems = part.to_setpoints(action[:, ours], mask, before[:, columns])
            made.append(setpoints)
            refused.update(problems)
        return np.concatenate(made, axis=1), refused

    # --- episodes ----------------------------------------------------------------------------------------------------

    def reset(self, ids: NDArray[np.intp], scenes: Sequence[Any], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start episodes.

        Args:
            ids: the robots.
            scenes: where each of them is.
            seeds: a seed for each of them.

        Returns:
            The state of the world that they begin with, shape (len(ids), k); of no width without a world.
        """
        ids = np.asarray(ids, np.intp)
        self.place(ids, scenes)
        self.bridge.restart(ids)
        for part in self.parts:
            part.begin(ids)
        self._start_tick[ids] = self.tick
        self.running[ids] = True
        return np.zeros((len(ids), 0))

    def stop(self, ids: NDArray[np.intp]) -> None:
        """Leave robots alone from now on: their episodes are over."""
        self.running[ids] = False

    def load(self) -> None:
        """Load the machine code that ticks run, before a loop on the wall clock begins."""
        self.cerebellum.load()

    # --- frames ------------------------------------------------------------------------------------------------------

    def observe(self) -> Frame:
        """Return what the robots see now."""
        sensed, oldest = self.sense()
        now = (self.tick - self._start_tick) * NANOSECONDS // self.rates.control_hz
        measured = (oldest - self._start_tick) * NANOSECONDS // self.rates.control_hz
        physics = {keys.PHYSICS_STATE: self.physics_state} if self.world is not None else {}
        return Frame(self.completed(sensed), now, now - measured, physics)

    def step(self, command: Command) -> FrameReport:
        """Send a command to the running robots and let one frame go by."""
        return self._frame(self.send(command), command)

    def act(self, command: Command) -> ActionReport:
        """Do what LeRobot's `send_action` does: here, let a frame go by."""
        return self.step(command)

    def begin(self) -> None:
        """Let the time of an episode begin, if it does not begin with the first observation."""
        return

    def latest(self) -> Frame:
        """Return the newest observation, whatever frame it is in."""
        return self.observe()

    def send(self, command: Command, start_ns: int | None = None) -> Acceptance:
        """Send a command to the running robots; no time goes by. Return what was accepted of it.

        Args:
            command: what the robots are to do; None continues with the last chunk or goal.
            start_ns: when a chunk begins [ns]; now if None.
        """
        receipt = Acceptance(SendResult(np.zeros(self.n, np.int8)))
        match command:
            case None:
                pass
            case Chunk(actions):
                self._send_chunk(actions, start_ns, receipt)
            case Goals(commands, setpoints):
                if setpoints is not None:
                    streamed = np.isin(np.arange(self.n), command.streamed)
                    self._send_setpoint(np.nan_to_num(setpoints), receipt, streamed)
                for sim, goals in commands.items():
                    refusals = [refusal for goal in goals if (refusal := self.bridge.submit(goal, sim)) is not None]
                    if refusals:
                        receipt.results[sim] = refusals
            case _:
                self._send_setpoint(command, receipt, self.running)
        return receipt

    def _send_setpoint(self, action: NDArray[np.float64], receipt: Acceptance, mask: NDArray[np.bool_]) -> None:
        mask = mask & self.running
        if not mask.any():
            return
        setpoints, refused = self.to_setpoints(action, mask, None)
        if refused:
            mask[list(refused)] = False
        receipt.sent = self.bridge.send(setpoints, mask)
        receipt.refuse(refused)

    def _send_chunk(self, actions: NDArray[np.float64], start_ns: int | None, receipt: Acceptance) -> None:
        rows: list[NDArray[np.float64]] = []
        for action in actions:
            setpoints, refused = self.to_setpoints(action, self.running, rows[-1] if rows else None)
            receipt.refuse(refused)
            if refused:
                break  # the actions before it are sent
            rows.append(setpoints)
        results = self.bridge.send_chunk(np.array(rows), self.running, start_ns) if rows else []
        if results:
            # Of each robot, the first reason that is a refusal.
            reasons = np.array([result.reasons for result in results])
            first = reasons[(reasons != 0).argmax(axis=0), np.arange(self.n)]
            sent = receipt.sent.reasons
            sent[sent == Reason.ACCEPTED] = first[sent == Reason.ACCEPTED]

    def _frame(self, receipt: Acceptance, command: Command) -> FrameReport:
        """Let one frame go by, and report what happened in it and to the command that it began with."""
        for flags in self.touches:
            flags[:] = False
        self.bridge.advance_frame()
        cerebellum = self.cerebellum
        limits, watchdog = cerebellum.take_flags()
        limits[list(receipt.refusals)] |= int(Limit.POSTURE)
        running = np.flatnonzero(self.running).tolist()
        results = {sim: receipt.all_results(sim, self.bridge.take_results(sim)) for sim in running}
        applied = self.to_action(cerebellum.command)
        return FrameReport(
            applied=applied,
            requested=self._requested(command, applied),
            sent=receipt.sent,
            limits=limits,
            watchdog=watchdog,
            mode=cerebellum.mode.copy(),
            truth=self.truth,
            columns=self.recorded(cerebellum.states, self.bridge.now_ns),
            results={sim: ended for sim, ended in results.items() if ended},
            refusals=receipt.refusals,
        )

    def _requested(self, command: Command, applied: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action that was requested for a frame, shape (n, actions)."""
        match command:
            case Goals(_, None):
                return applied
            case Goals(_, setpoints):
                assert setpoints is not None
                return np.where(np.isfinite(setpoints), setpoints, applied)
            case None | Chunk():
                return self.to_action(self.cerebellum.requested)  # of a chunk its row for this frame, or its last
            case _:
                return command

    @property
    def problem(self) -> str:
        """Why robots were last stopped by a fault, as text; empty if that is not known."""
        return self.cerebellum.readings.problem

    @property
    def notes(self) -> list[str]:
        """Nothing has to be known of a simulation before it moves."""
        return []

    @property
    def estop_pressed(self) -> bool:
        """Whether the emergency stop of any robot is pressed, be it latched already or not."""
        return self.bridge.estop_pressed

    def estop(self) -> None:
        """Press the emergency stop of all robots."""
        self.bridge.estop()

    @property
    def modes(self) -> NDArray[np.int8]:
        """The present `Mode` of each robot, shape (n,)."""
        return self.cerebellum.mode

    def recorded(self, states: NDArray, now_ns: int) -> dict[str, NDArray]:
        """Return what frames hold of records, beside what was applied and flags, by key.

        Args:
            states: the records, shape (n,).
            now_ns: the time of their tick [ns].
        """
        columns = {
            keys.COMMAND_AGE: command_age_ns(states, now_ns) / NANOSECONDS,
            keys.EFFORT: states["torque"][:, : self.controller.joints].copy(),
        }
        if self._has_wrench:
            columns[keys.WRENCH] = states["wrench"].copy()
        return columns

    @property
    def columns(self) -> dict[str, tuple[str, ...]]:
        """What frames and reports hold beside observation and action: names of the values by key, none for a number."""
        columns: dict[str, tuple[str, ...]] = {
            keys.COMMAND_AGE: (),
            keys.EFFORT: tuple(f"{joint}.effort" for joint in self.body.joints),
        }
        if self._has_wrench:
            columns[keys.WRENCH] = tuple(f"tool_{kind}_{axis}" for kind in ("force", "moment") for axis in "xyz")
        if self.world is not None:
            nq, nv = (part.shape[1] for part in self.physics)
            columns[keys.PHYSICS_STATE] = (*(f"qpos_{i}" for i in range(nq)), *(f"qvel_{i}" for i in range(nv)))
        return columns

    @property
    def physics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Generalised positions, shape (n, nq), and velocities, shape (n, nv), live; of no width without a world."""
        return self._no_physics

    @property
    def physics_state(self) -> NDArray[np.float64]:
        """Generalised positions and velocities, shape (n, nq + nv), a copy."""
        return np.concatenate(self.physics, axis=1)

    # --- images: a host without cameras has none ---------------------------------------------------------------------

    def render(self, sim: int, camera: str) -> NDArray[np.uint8]:
        """Return what a camera of one robot sees now, shape (height, width, 3)."""
        raise self._no_camera(camera)

    def start_rendering(self) -> None:
        """Get ready for `render_later`.

        Raises:
            RenderingError: no image can be rendered here.
        """
        return

    def render_later(self, sim: int, camera: str, deliver: Deliver | None = None) -> Future[NDArray[np.uint8]]:
        """Return what a camera of one robot sees now, as an image to come; see `Robots.render_later`."""
        raise self._no_camera(camera)

    def _no_camera(self, camera: str) -> ConfigError:
        return ConfigError(f"There is no camera {camera!r}: {self.config.type} observes none.")

    # --- inside a tick -----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Let one control tick go by."""
        self.tick += 1

    def run_tick(self, now_ns: int, ticks: int) -> None:
        """Run one tick of control on the wall clock, and let the robot go on by some ticks.

        Args:
            now_ns: the time that the tick is for [ns].
            ticks: how many; more than one after ticks that were skipped.
        """
        self.cerebellum.tick(now_ns)
        for _ in range(ticks):
            self.advance()

    def run_ticks(self, number: int, most: int) -> int:
        """Run ticks of control and world at once, see `LockstepBridge`; none here."""
        return 0

    def close(self) -> None:
        """Free everything. May be called twice."""
        return


def _one(parts: Sequence[Part]) -> Controller:
    """Return the controller of all parts."""
    if len(parts) == 1:
        return parts[0].controller
    from bhd_lerobot.control.arm.mobile import MobileArmController

    arm, drive = (part.controller for part in parts)
    return MobileArmController(arm, drive)  # type: ignore[arg-type]


def _places(widths: Sequence[int]) -> list[slice]:
    """Return where values of these widths are, one after the other."""
    return [slice(sum(widths[:k]), sum(widths[: k + 1])) for k in range(len(widths))]


LEFT_OUT_IF_OFF = ("plant", "jerk_limits", "payload", "wrench", "obstacles", "collision_monitor", "servos")
"""Options that `describe` does not mention where they are off, as in the data of versions that did not have them."""


def describe(config: Any) -> dict[str, Any]:
    """Return everything about a robot that shapes its data, as plain values; of an absolute path its name."""
    if not hasattr(config, "clock"):
        return _described(config)
    left_out = ["id", "calibration_dir", "seed", "arena", "scene", "realtime", "ros2", "device", "units"]
    left_out += config.not_recorded
    if config.clock == "lockstep":
        left_out.append("require_realtime")  # it has no effect
    left_out += [name for name in LEFT_OUT_IF_OFF if not getattr(config, name, None)]
    plain = {key: asdict(value) if is_dataclass(value) else value for key, value in vars(config).items()}  # type: ignore[arg-type]
    values = {key: _without_place(value) for key, value in plain.items() if key not in left_out}
    return {
        "type": config.type,
        **values,
        **({"realtime": asdict(config.realtime)} if config.clock == "realtime" else {}),
    }


_WHERE = re.compile("id|calibration_dir|port|.*_port|ip|.*_ip|host|address|.*path|.*token|.*password|.*secret", re.I)
"""Options of another package's robot that say where it is, not what it is."""


def _described(config: Any) -> dict[str, Any]:
    """Return everything about a robot of another package that is not where it is, as plain values."""

    def without_places(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return {key: without_places(one) for key, one in value.items() if not _WHERE.fullmatch(str(key))}

    described: dict[str, Any] = without_places(draccus.encode(config))
    return {"type": config.type, **described}


def _without_place(value: Any) -> Any:
    """Return an option of a robot as it is recorded: nothing of where something lies on this machine."""
    if not isinstance(value, Path):
        return value
    return value.name if value.expanduser().is_absolute() else str(value)
