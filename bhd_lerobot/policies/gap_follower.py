"""Follow the gap that leads to most new ground."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.brain import Observation, find_columns, find_scan

Array = NDArray[np.float64]

HULL = (-0.102, 0.038, 0.070)
WHEELS = (-0.033, 0.033, 0.089)
LIDAR_X = -0.032
HALF_TRACK = 0.08
QUANTUM = 0.02
BIN = 0.02
MEMORY = 128


@dataclass
class GapFollowerConfig:
    forward_speed: float = 0.22
    wheel_speed: float = 0.2272
    max_turn: float = 2.0
    families: tuple = ((0.25, 180), (0.0, 180), (0.8, 90), (2.4, 60))
    wide_m: float = 0.2
    narrow: float = 1.0
    need_m: float = 9.0
    headings: int = 48
    margin_m: float = 0.05
    tight_margin_m: float = 0.02
    horizon_m: float = 3.4
    step_m: float = 0.2
    stop_m: float = 0.1
    cell_m: float = 0.125
    mark_m: float = 0.2
    memory_s: float = 120.0
    discount: float = 0.9
    turn_weight: float = 0.3
    commit_weight: float = 0.5
    clear_weight: float = 0.3
    settle_s: float = 0.35
    hold: float = 1.01
    old: float = 0.2
    range_min_m: float = 0.12
    range_max_m: float = 3.5


class GapFollowerBrain:
    name = "gap_follower"

    def __init__(self, config: GapFollowerConfig | None = None) -> None:
        self.config = config or GapFollowerConfig()

    def bind(self, observation_names: Sequence[str], action_names: Sequence[str], fps: int) -> None:
        c = self.config
        self._scan, angles = find_scan(observation_names, self.name)
        self._twist = find_columns(observation_names, ("x.vel", "theta.vel"), self.name, "observation")
        self._forward, self._turn = find_columns(action_names, ("x.vel", "theta.vel"), self.name, "action")
        self._width = len(action_names)
        self._dt = 1.0 / fps
        beams = len(angles)
        self._group = next(g for g in range(max(1, beams // 120), beams + 1) if beams % g == 0)
        self._sectors = beams // self._group
        # sector s holds beams s*g .. s*g+g-1; its middle:
        mid = 2 * np.pi * (np.arange(self._sectors) * self._group + (self._group - 1) / 2) / beams
        spread = math.pi * max(self._group - 1, 0.5) / beams
        k = np.arange(c.headings)
        h = 2 * np.pi * k / c.headings
        h = np.where(h > np.pi, h - 2 * np.pi, h)
        fam = [(r, h[np.abs(h) <= math.radians(lim) + 1e-9]) for r, lim in c.families]
        self._heading = np.concatenate([x for _, x in fam])
        self._radius = np.concatenate([np.full(len(x), r) for r, x in fam])
        self._turncost = np.abs(self._heading) * self._rate(self._radius)
        self._lost = (self._turncost - np.abs(self._heading) * self._radius) / (HALF_TRACK * np.pi)
        self._comfort = self._table(mid, spread, c.margin_m)
        self._wide = self._table(mid, spread, c.wide_m)
        self._tight = self._table(mid, spread, c.tight_margin_m)
        # sample points
        turn = self._turncost
        cost = np.arange(1, int(c.horizon_m / c.step_m) + 1) * c.step_m
        self._cost = cost
        phi = np.minimum(cost[None] / self._rate(self._radius)[:, None], np.abs(self._heading)[:, None])
        straight = np.maximum(cost[None] - turn[:, None], 0.0)
        r = self._radius[:, None]
        sign = np.sign(self._heading)[:, None]
        self._px = r * np.sin(phi) + straight * np.cos(phi)
        self._py = sign * (r * (1 - np.cos(phi)) + straight * np.sin(phi))
        self._need = np.ceil((cost + 0.0) / QUANTUM).astype(np.uint8)
        self._weight = np.round(1000 * c.discount ** np.arange(len(cost))).astype(np.int32)
        # a point that coincides with the one before it (turning on the spot) brings nothing
        moved = np.hypot(np.diff(self._px, axis=1, prepend=0), np.diff(self._py, axis=1, prepend=0)) > c.step_m / 2
        self._weights = (self._weight[None] * moved).astype(np.int32)

    def _rate(self, r):
        c = self.config
        return np.maximum(r, (r + HALF_TRACK) * c.forward_speed / c.wheel_speed)

    def _table(self, mid: Array, spread: float, margin: float) -> NDArray[np.uint8]:
        c = self.config
        bins = int(math.ceil((c.range_max_m) / BIN)) + 1
        r = (np.arange(bins) + 0.5) * BIN
        x = LIDAR_X + r[None] * np.cos(mid)[:, None]
        y = r[None] * np.sin(mid)[:, None]
        m = np.broadcast_to(margin + r[None] * math.sin(spread), x.shape)
        m = np.minimum(m, np.maximum(_distance(x, y) - 0.005, 0.0))
        out = np.empty((len(mid), bins, len(self._heading)), np.uint8)
        for i, (h, radius) in enumerate(zip(self._heading, self._radius, strict=True)):
            s = math.copysign(1.0, h)
            clear = np.full(x.shape, 255 * QUANTUM)
            steps = max(1, math.ceil(abs(h) / math.radians(7.5)), math.ceil(abs(h) * radius / 0.05))
            for phi in np.linspace(abs(h), 0.0, steps + 1):
                qx, qy = x - radius * math.sin(phi), y - s * radius * (1 - math.cos(phi))
                co, si = math.cos(phi), s * math.sin(phi)
                qx, qy = co * qx + si * qy, co * qy - si * qx
                cost = phi * self._rate(radius)
                if phi == abs(h):
                    for _, front, half in (HULL, WHEELS):
                        hit = (np.abs(qy) < half + m) & (qx > front)
                        clear = np.where(hit, np.minimum(clear, cost + np.maximum(qx - front - m, 0.0)), clear)
                clear = np.where(_distance(qx, qy) < m, cost, clear)
            out[:, :, i] = np.floor(np.minimum(clear / QUANTUM, 255))
        return out

    def reset(self, ids: NDArray[np.intp], seeds: Sequence[int], n: int) -> None:
        if not hasattr(self, "_pose") or len(self._pose) != n:
            self._pose = np.zeros((n, 3))
            self._memory = np.zeros((n, MEMORY * MEMORY), np.int32)
            self._frame = np.zeros(n, np.int32)
            self._goal = np.full(n, np.nan)
            self._last = np.zeros((n, 2))
        self._pose[ids] = 0
        self._memory[ids] = 0
        self._frame[ids] = 0
        self._goal[ids] = np.nan
        self._last[ids] = 0

    def act(self, observation: Observation) -> NDArray[np.float64]:
        c = self.config
        n = len(observation.state)
        self._update(observation.state[:, self._twist])
        scan = observation.state[:, self._scan]
        valid = (scan >= c.range_min_m) & (scan <= c.range_max_m)
        near = np.where(valid, scan, np.inf).reshape(n, self._sectors, self._group).min(axis=2)
        blind = np.isinf(near)
        if blind.any():
            near = np.where(blind, np.minimum(np.roll(near, 1, axis=1), np.roll(near, -1, axis=1)), near)
        blind = np.isinf(near).any(axis=1)
        near[np.isinf(near)] = c.range_min_m
        index = (near / BIN).astype(np.intp) + np.arange(self._sectors) * self._comfort.shape[1]
        clear = self._comfort.reshape(-1, len(self._heading))[index].min(axis=1)
        go = int(c.stop_m / QUANTUM)
        turncost = np.minimum(self._turncost, c.need_m)
        enough = np.ceil((turncost + c.stop_m) / QUANTUM).astype(np.int32)
        ok = clear >= enough
        self._dbg = clear
        lost = ~ok.any(axis=1)
        if lost.any():
            clear[lost] = self._tight.reshape(-1, len(self._heading))[index[lost]].min(axis=1)
            ok[lost] = clear[lost] >= enough
        # gains
        pose = self._pose
        co, si = np.cos(pose[:, 2])[:, None, None], np.sin(pose[:, 2])[:, None, None]
        cell = self._cell(
            pose[:, 0, None, None] + co * self._px - si * self._py,
            pose[:, 1, None, None] + si * self._px + co * self._py,
        )
        stamp = self._memory[np.arange(n)[:, None, None], cell]
        age = self._frame[:, None, None] - stamp
        horizon = int(c.memory_s / self._dt)
        value = np.where(stamp == 0, 100, np.minimum(age * int(100 * c.old) // horizon, 100)).astype(np.int32)
        value = value * self._weights
        value *= clear[:, :, None] >= self._need
        if c.narrow < 1:
            wide = self._wide.reshape(-1, len(self._heading))[index].min(axis=1)
            value *= np.where(wide[:, :, None] >= self._need, 10, int(10 * c.narrow))
            value //= 10
        gain = value.sum(axis=2) / (100.0 * self._weight.sum())
        score = gain - c.turn_weight * self._lost + c.clear_weight * np.minimum(clear * QUANTUM / c.horizon_m, 1.0)
        goal = np.where(np.isnan(self._goal), pose[:, 2], self._goal)
        off = np.abs(_wrap(pose[:, 2, None] + self._heading - goal[:, None]))
        score -= c.commit_weight * np.minimum(off / 0.5, 1.0)
        score = np.where(ok, score, -10 + clear * 0.01)
        best = score.argmax(axis=1)
        moving = ok[np.arange(n), best]
        h, radius = self._heading[best], self._radius[best]
        toward = _wrap(goal - pose[:, 2])
        h = np.where(np.abs(_wrap(toward - h)) <= c.hold * 2 * np.pi / c.headings, toward, h)
        self._goal = np.where(moving, _wrap(pose[:, 2] + h), self._goal)
        turn = np.minimum(np.abs(h) / c.settle_s, np.where(radius > 0, c.wheel_speed / (radius + HALF_TRACK), c.max_turn))
        forward = np.minimum(c.forward_speed, c.wheel_speed - HALF_TRACK * turn)
        forward = np.where((radius > 0) | (turn < 0.3), forward, 0.0)
        forward = np.where(moving, np.maximum(forward, 0), 0.0)
        action = np.zeros((n, self._width))
        action[:, self._forward] = np.where(blind, 0.0, forward)
        action[:, self._turn] = np.where(blind, 0.0, np.copysign(turn, h))
        self._stuck = ~moving
        return action

    def _update(self, twist: Array) -> None:
        twist = np.where(np.isfinite(twist), twist, 0.0)
        mean = (twist + self._last) / 2
        self._last = twist
        first = self._frame == 0
        mean[first] = 0
        yaw = self._pose[:, 2] + mean[:, 1] * self._dt / 2
        self._pose[:, 0] += mean[:, 0] * self._dt * np.cos(yaw)
        self._pose[:, 1] += mean[:, 0] * self._dt * np.sin(yaw)
        self._pose[:, 2] += mean[:, 1] * self._dt
        self._frame += 1
        a = np.arange(8) * np.pi / 4
        ox = np.append(self.config.mark_m * np.cos(a), 0.0)
        oy = np.append(self.config.mark_m * np.sin(a), 0.0)
        cell = self._cell(self._pose[:, 0, None] + ox, self._pose[:, 1, None] + oy)
        self._memory[np.arange(len(cell))[:, None], cell] = self._frame[:, None]

    def _cell(self, x: Array, y: Array) -> NDArray[np.intp]:
        column = np.floor(x * (1 / self.config.cell_m)).astype(np.intp) & (MEMORY - 1)
        row = np.floor(y * (1 / self.config.cell_m)).astype(np.intp) & (MEMORY - 1)
        return row * MEMORY + column


def _distance(x: Array, y: Array) -> Array:
    d = np.full(x.shape, np.inf)
    for rear, front, half in (HULL, WHEELS):
        dx = np.maximum(np.maximum(rear - x, x - front), 0)
        dy = np.maximum(np.abs(y) - half, 0)
        d = np.minimum(d, np.hypot(dx, dy))
    return d


def _wrap(a: Array) -> Array:
    return (a + np.pi) % (2 * np.pi) - np.pi
