"""Which postures reach a pose, and may be taken: inverse kinematics with limits, collisions and singularities."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import ArmChain, Limits
from bhd_lerobot.control.commands import ResultCode
from bhd_lerobot.control.geometry.collision import CollisionModel
from bhd_lerobot.control.geometry.forward_kinematics import ForwardKinematics
from bhd_lerobot.control.geometry.inverse_kinematics import ClosedForm, wrist_centre
from bhd_lerobot.control.geometry.numeric_inverse import REACHED, NumericInverse
from bhd_lerobot.errors import ConfigError

Array = NDArray[np.float64]
Codes = NDArray[np.int64]

TURN = 2 * np.pi
_AT_LIMIT = 1e-9  # a joint this far beyond its limit is at its limit [rad]
_ROTATION_ERROR = 1e-6  # how far the columns of a rotation may be from orthonormal
_START_ERROR = 1e-3  # how far a line may start from the posture that it is to start from [rad]
_LARGEST_STEP = 1.0  # a joint that turns further between two poses of a line has changed its branch [rad]
_TURNED = 1e-3  # [1] by how much more the axes of the tool may be off than they have to be
_SAME = 1e-4  # [rad] postures that differ by less are one
_JUMP = "A joint would have to jump between two poses, at a singular posture."
_ADMISSIBLE = int(ResultCode.SUCCEEDED)
_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class IkResult:
    """Postures that were found, or why there are none.

    Attributes:
        postures: joint positions [rad], shape (k, dof); empty unless succeeded.
        message: what was in the way, with numbers and a remedy; empty if succeeded.
        index: number of the pose of a line that cannot be reached, or None.
        turned: angle by which the tool is turned away from the pose in each posture [rad], shape (k,); more than
            rounding only for an arm with fewer than six joints.
    """

    code: ResultCode
    postures: Array
    message: str = ""
    index: int | None = None
    turned: Array = field(default_factory=lambda: np.empty(0))


class ArmKinematics(ForwardKinematics):
    """Forward and inverse kinematics of an arm.

    Poses are tool frames in the base frame, shape (..., 4, 4). A chain whose axes lie as those of a UR is solved in
    closed form, every other one as `numeric_inverse` describes it.

    Args:
        limits: limits of its commands, the joints' first.

    Raises:
        ConfigError: the chain has too many joints, or too few limits.
    """

    def __init__(self, chain: ArmChain, limits: Limits) -> None:
        super().__init__(chain)
        if len(limits.names) < self.dof:
            raise ConfigError(f"There are limits for {len(limits.names)} commands; the arm has {self.dof} joints.")
        self.collision = CollisionModel(chain)
        self.lower, self.upper = np.array(limits.lower[: self.dof]), np.array(limits.upper[: self.dof])
        self._lowest, self._highest = self.lower - _AT_LIMIT, self.upper + _AT_LIMIT
        self._closed = ClosedForm.of(self)
        self._numeric = NumericInverse(self, self.lower, self.upper) if self._closed is None else None

    def solutions(self, pose: Array, posture: Array | None = None) -> Array:
        """Return postures that reach a pose, permitted or not, shape (..., k, dof); NaN for a branch that does not.

        Args:
            pose: shape (..., 4, 4); of a chain without a closed form (4, 4).
            posture: where the arm is [rad], shape (..., dof). What the pose leaves free stays as it is there.
        """
        if self._closed is not None:
            return self._closed.solutions(pose, 0.0 if posture is None else posture[..., -1])
        assert self._numeric is not None
        posture = np.clip(np.zeros(self.dof), self.lower, self.upper) if posture is None else posture
        *_, (found, _) = self._numeric.search(pose, posture)
        return found

    def check(self, q: Array) -> Codes:
        """Return for each posture the first check that it fails, or SUCCEEDED.

        Args:
            q: joint positions [rad], shape (..., dof).

        Returns:
            JOINT_LIMIT, SELF_COLLISION, TABLE_COLLISION, SINGULAR or SUCCEEDED as numbers, shape (...).
        """
        self_distance, table_distance = self.collision.distances(q)
        failures = (  # the last that is written is the first check
            (ResultCode.SINGULAR, self.manipulability(q) < self.chain.min_manipulability),
            (ResultCode.TABLE_COLLISION, table_distance < self.chain.min_distance),
            (ResultCode.SELF_COLLISION, self_distance < self.chain.min_distance),
            (ResultCode.JOINT_LIMIT, ((q < self._lowest) | (q > self._highest)).any(axis=-1)),
        )
        codes = np.full(np.shape(q)[:-1], _ADMISSIBLE)
        for code, failed in failures:
            np.copyto(codes, int(code), where=failed)
        return codes

    def explain(self, q: Array) -> str:
        """Return what `check` holds against a posture of shape (dof,), with numbers and a remedy; empty if nothing."""
        code = ResultCode(int(self.check(q[None])[0]))
        chain = self.chain
        if code == ResultCode.JOINT_LIMIT:
            joint = int(np.argmax(np.maximum(self.lower - q, q - self.upper)))
            return (
                f"{chain.joints[joint]} would be at {q[joint]:.3f} rad; its limits are {self.lower[joint]:.3f} and "
                f"{self.upper[joint]:.3f}. Choose another pose, or turn the joint back first."
            )
        self_distance, table_distance = (float(distance) for distance in self.collision.distances(q))
        if code == ResultCode.SELF_COLLISION:
            first, second = self.collision.closest_pair(q)
            return (
                f"{first} and {second} would come within {self_distance:.4f} m; {chain.min_distance} m is the least. "
                "Move the tool away from the arm, or turn it."
            )
        if code == ResultCode.TABLE_COLLISION:
            return (
                f"{self.collision.lowest(q)} would come within {table_distance:.4f} m of the table; "
                f"{chain.min_distance} m is the least. Raise the tool, or tilt it."
            )
        if code == ResultCode.SINGULAR:
            return (
                f"The posture is singular: its manipulability is {float(self.manipulability(q)):.2e} m^3 and "
                f"{chain.min_manipulability:.2e} the least. Move the tool, or turn it."
            )
        return ""

    def solve(self, pose: Array, posture: Array) -> IkResult:
        """Return the postures that reach a pose and may be taken.

        Every joint takes the turn that is nearest to `posture` within its limits.

        Args:
            pose: shape (4, 4).
            posture: joint positions now [rad], shape (dof,).

        Returns:
            The postures, the one with the smallest largest change of a joint first; or the last check that the
            remaining ones failed.
        """
        refused = _check_poses(pose[None], posture)
        if refused is not None:
            return refused
        if self._numeric is None:
            found = self.solutions(pose, posture)
            found = found[found[:, 0] == found[:, 0]]
            return self._chosen(pose, posture, found, np.zeros((len(found), 3)))
        for found, off in self._numeric.search(pose, posture):
            result = self._chosen(pose, posture, found, off)
            if result.code == ResultCode.SUCCEEDED and result.turned[0] < REACHED:
                break
        return result

    def continued(self, pose: Array, posture: Array) -> IkResult:
        """Return the postures that reach the next of a stream of poses, see `solve`; the first goes on from `posture`.

        An arm with fewer than six joints is turned away from nearly every pose that is not made for it. The posture
        that is turned least may be far away, and is not the one that the stream has led to.
        """
        if self._numeric is not None and _check_poses(pose[None], posture) is None:
            found, off = self._numeric.descend(pose, posture, posture[None])
            if self._numeric.reaches(off)[0] and self.check(found)[0] == _ADMISSIBLE:
                return IkResult(ResultCode.SUCCEEDED, found, turned=off[:, 1])
        return self.solve(pose, posture)

    def _chosen(self, pose: Array, posture: Array, found: Array, off: Array) -> IkResult:
        """Return which of the postures that reach a pose may be taken, the least turned and then the nearest first."""
        if not len(found):
            return _failed(len(posture), ResultCode.UNREACHABLE, self._why_unreachable(pose, posture))
        found = self._nearest_turns(found, posture)
        change = np.abs(found - posture)
        order = np.lexsort((change.sum(axis=1), change.max(axis=1), np.rint(off[:, 2] / _TURNED)))
        found, off = found[order], off[order]
        codes = self.check(found)
        admissible = codes == _ADMISSIBLE
        if admissible.any():
            admissible &= off[:, 2] < off[admissible, 2][0] + _TURNED
            if self._numeric is not None:
                same = (np.abs(found[:, None] - found).max(axis=2) < _SAME) & admissible
                admissible &= same.argmax(axis=1) == np.arange(len(found))
            postures = np.minimum(np.maximum(found[admissible], self.lower), self.upper)
            return IkResult(ResultCode.SUCCEEDED, postures, turned=off[admissible, 1])
        # The checks are numbered in their order, so the largest number is the check that removed the last posture.
        worst = int(codes.argmax())
        return _failed(len(posture), ResultCode(int(codes[worst])), self.explain(found[worst]))

    def line(self, poses: Array, posture: Array) -> IkResult:
        """Return the postures along a path of the tool, all on the branch of the first.

        Args:
            poses: the path, close enough together that no joint turns by 1 rad from one to the next, shape (K, 4, 4).
            posture: the posture in `poses[0]` [rad], shape (dof,).

        Returns:
            Postures of shape (K, dof), continuous from `posture`; or the first pose that cannot be taken and why.
        """
        refused = _check_poses(poses, posture)
        if refused is not None:
            return refused
        path = self._trace(poses, posture) if self._numeric is None else self._follow(self._numeric, poses, posture)
        if isinstance(path, IkResult):
            return path
        codes = self.check(path)
        codes[1:][np.abs(np.diff(path, axis=0)).max(axis=1) > _LARGEST_STEP] = ResultCode.SINGULAR
        bad = codes != _ADMISSIBLE
        if bad.any():
            index = int(bad.argmax())
            message = self.explain(path[index]) or _JUMP
            return _failed(len(posture), ResultCode(int(codes[index])), message, index)
        if len(path) < len(poses):
            there = poses[len(path)]
            if self._numeric is not None and self.solve(there, path[-1]).code == ResultCode.SUCCEEDED:
                return _failed(len(posture), ResultCode.SINGULAR, _JUMP, len(path))
            why = self._why_unreachable(there, path[-1])
            return _failed(len(posture), ResultCode.UNREACHABLE, why, len(path))
        return IkResult(ResultCode.SUCCEEDED, np.minimum(np.maximum(path, self.lower), self.upper))

    def _trace(self, poses: Array, posture: Array) -> Array | IkResult:
        """Return the postures of the closed form along a path, up to the first pose that it does not reach."""
        found = self.solutions(poses, posture)
        away = found[0] - posture
        away = np.abs(away - TURN * np.rint(away / TURN)).max(axis=1)
        away[np.isnan(away)] = np.inf
        branch = int(away.argmin())
        if not away[branch] < _START_ERROR:
            return self._starts_elsewhere(poses[0], posture, float(away[branch]))
        path = found[:, branch]
        before = np.concatenate((posture[None], path[:-1]))
        path = path - TURN * np.cumsum(np.rint((path - before) / TURN), axis=0)
        missing = np.isnan(path).any(axis=1)
        return path[: int(missing.argmax())] if missing.any() else path

    def _follow(self, numeric: NumericInverse, poses: Array, posture: Array) -> Array | IkResult:
        """Return postures along a path, each solved from the one before, up to the first pose that is not reached."""
        path, before = np.empty((len(poses), self.dof)), posture
        for index, pose in enumerate(poses):
            for limited in (True, False):  # beyond a limit, the check says which
                found, off = numeric.descend(pose, before, before[None], limited=limited)
                if numeric.reaches(off)[0]:
                    break
            else:
                return path[:index] if index else self._starts_elsewhere(pose, posture, np.inf)
            path[index] = before = found[0]
        away = float(np.abs(path[0] - posture).max())
        return path if away < _START_ERROR else self._starts_elsewhere(poses[0], posture, away)

    def _starts_elsewhere(self, pose: Array, posture: Array, away: float) -> IkResult:
        message = f"The line starts {away:.4f} rad from the posture; {_START_ERROR} is the most."
        if np.isinf(away):
            message = self._why_unreachable(pose, posture)
        return _failed(len(posture), ResultCode.UNREACHABLE, message, 0)

    def _nearest_turns(self, q: Array, posture: Array) -> Array:
        """Return postures with each joint in that turn within its limits which is nearest to `posture`."""
        turns = np.rint((posture - q) / TURN)
        turns = np.minimum(turns, np.floor((self._highest - q) / TURN))
        turns = np.maximum(turns, np.ceil((self._lowest - q) / TURN))
        return q + TURN * turns

    def _why_unreachable(self, pose: Array, posture: Array) -> str:
        """Return what keeps an arm from a pose of shape (4, 4), with numbers and a remedy."""
        if self._numeric is not None:
            short, angle = self._numeric.nearest(pose, posture)
            return (
                f"The tool comes no nearer to the pose than {short:.3g} m and {angle:.3g} rad. Move the pose towards "
                "the base, or turn it."
            )
        assert self._closed is not None
        arm = self._closed.arm
        centre = wrist_centre(arm, self._closed.inside(pose))
        beside, least = float(np.hypot(centre[0], centre[1])), abs(arm.d4)
        if beside < least:
            return (
                f"The wrist would be {beside:.3f} m from the base's axis; {least:.3f} m is the least. "
                "Move the tool away from the axis."
            )
        nearest = self.tool(self._closed.nearest(pose, float(posture[5])))
        short = np.sqrt(np.square(nearest[:, :3, 3] - pose[:3, 3]).sum(axis=1)).min()
        far = np.sqrt(np.square(centre - (0.0, 0.0, arm.d1)).sum())
        where = "too far away: move it towards" if far > abs(arm.a2) else "too near: move it away from"
        return f"The arm ends {short:.3f} m short of the pose, which is {where} the base's axis, or turn it."


def _check_poses(poses: Array, posture: Array) -> IkResult | None:
    """Return why the numbers themselves are refused, or None; `poses` has shape (K, 4, 4)."""
    if not np.isfinite(posture).all():
        return _failed(len(posture), ResultCode.NON_FINITE, f"The posture is {posture.tolist()}; all must be finite.")
    finite = np.isfinite(poses)
    if not finite.all():
        index = int(finite.all(axis=(1, 2)).argmin())
        return _failed(
            len(posture), ResultCode.NON_FINITE, f"The pose is {poses[index].tolist()}; all must be finite.", index
        )
    rotations = poses[:, :3, :3]
    error = np.zeros((len(poses), 5, 3))
    error[:, :3] = (rotations[:, :, :, None] * rotations[:, :, None, :]).sum(axis=1) - _IDENTITY
    error[:, 3] = poses[:, 3, :3]
    error[:, 4, 0] = poses[:, 3, 3] - 1.0
    error[:, 4, 1] = np.linalg.det(rotations) < 0.0  # mirrored
    wrong = np.abs(error) > _ROTATION_ERROR
    if wrong.any():
        index = int(wrong.any(axis=(1, 2)).argmax())
        largest = float(np.abs(error[index]).max())
        message = f"The pose is {largest:.2e} from a rotation and a translation; {_ROTATION_ERROR} is the most."
        return _failed(len(posture), ResultCode.NOT_NORMALISED, f"{message} Normalise the orientation.", index)
    return None


def _failed(dof: int, code: ResultCode, message: str, index: int | None = None) -> IkResult:
    return IkResult(code, np.empty((0, dof)), message, index)
