"""A trained `bhd_perception` as brains use it: an image in, objects with their errors out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.bodies.body import Arm, Workspace
from bhd_lerobot.bodies.registry import BODIES
from bhd_lerobot.bodies.tabletop import COLOURS, scene_camera
from bhd_lerobot.errors import ConfigError, PerceptionError
from bhd_lerobot.options.declared import Count, Options, Positive, Range
from bhd_lerobot.policies.learned.checkpoint import find_checkpoint, recorded_path, weights_digest
from bhd_lerobot.policies.learned.contract import PolicyContract
from bhd_lerobot.policies.manipulation.grasp import SeenObject

if TYPE_CHECKING:
    from bhd_lerobot.policies.perception.modeling_perception import Detections

_RADIUS_50, _RADIUS_90 = 1.678346990016661, 3.889720169867429  # quantiles of a Gamma distribution of shape 2
# Brightness of the brightest pixel, and the colours' standard deviation over the image, below which nothing is shown.
_DARK, _FLAT = 8, 3.0


@dataclass
class PerceptionOptions(Options, prefix="brain.perception."):
    """How a brain sees.

    Attributes:
        path: the checkpoint of a `bhd_perception`; if not set, objects are looked up in what the task reports, which in
            simulation is the truth.
        device: where it runs: `cpu`, `cuda`, …
        max_error_m: an object whose place is not known better than this, with 90 % probability, is not grasped [m].
        min_certainty: nothing is taken for an object of a kind and colour that is less certain than this. The default
            was chosen on episodes of the split `validation` (docs/reference/policies.md has what others cost).
        threads: CPU threads; more than one make a network of this size slower beside anything else.
    """

    path: str = ""
    device: str = "cpu"
    max_error_m: Positive = 0.03
    min_certainty: Annotated[float, Range("[0, 1)")] = 0.1
    threads: Count = 1


@dataclass(frozen=True)
class PerceivedObject(SeenObject):
    """An object as a camera shows it.

    Attributes:
        error_50_m: radius around `position`, in x and y, within which it is with a probability of 50 % [m].
        error_90_m: likewise 90 % [m].
        certainty: probability that there is an object and that it has this kind and colour.
        alternatives: what it may be instead, the likeliest first.
    """

    error_50_m: float = field(default=0.0, kw_only=True)
    error_90_m: float = field(default=0.0, kw_only=True)
    certainty: float = field(default=1.0, kw_only=True)
    alternatives: tuple["PerceivedObject", ...] = field(default=(), kw_only=True)


class Perceiver:
    """Finds objects in images."""

    def __init__(self, options: PerceptionOptions) -> None:
        from bhd_lerobot.policies.learned.policy import load_perception

        folder = find_checkpoint(options.path)
        self.path = recorded_path(options.path, folder)
        self.who = f"The perception {options.path!r}"
        contract = PolicyContract.load(folder)
        self.dataset, self._robot_type = dict(contract.dataset or {}), contract.robot_type
        self._policy = load_perception(folder, options.device)
        self.weights = weights_digest(folder)
        self._device, self._least, self._threads = options.device, options.min_certainty, options.threads
        self.camera: str = self._policy.config.camera
        self.image_size: tuple[int, int] = self._policy.config.image_size

    def check(self, cameras: Mapping[str, Sequence[int]]) -> None:
        """Check that the camera that it looks through is there, and its images are of the size that it knows.

        Args:
            cameras: image shapes (height, width, channels) [px] by camera name.
        """
        width, height = self.image_size
        if self.camera not in cameras:
            raise ConfigError(
                f"{self.who} looks through the camera {self.camera!r}, which this robot does not have. There is: "
                f"{', '.join(cameras) or 'none'}. Set --robot.camera=true --robot.camera_width={width} "
                f"--robot.camera_height={height}."
            )
        shape = tuple(cameras[self.camera])
        if shape != (height, width, 3):
            raise ConfigError(
                f"{self.who} was trained on images of {width} x {height} px; those of the camera {self.camera!r} are "
                f"{shape[1]} x {shape[0]}. Set --robot.camera_width={width} --robot.camera_height={height}."
            )

    def check_arm(self, robot_type: str, workspace: Workspace) -> None:
        """Check that an arm's table and camera stand where those of the arm do that it was trained before."""
        trained = self._robot_type or robot_type
        if trained == robot_type or not robot_type or trained not in BODIES:
            return
        there = BODIES[trained]().need(Arm).workspace
        if (there.table, scene_camera(there)) != (workspace.table, scene_camera(workspace)):
            raise ConfigError(
                f"{self.who} was trained on tables of a {trained}, where table and camera stand elsewhere than before "
                f"a {robot_type}. Train one on recordings of a {robot_type}."
            )

    def look(self, images: Mapping[str, NDArray[np.uint8]], sim: int) -> list[PerceivedObject]:
        """Return the objects that one robot's camera shows, the surest first.

        `images`: by camera, shape (n, height, width, 3), RGB.
        """
        import torch

        from bhd_lerobot.policies.learned.inference import use_threads

        self.check({name: several.shape[1:] for name, several in images.items()})
        image = images[self.camera][sim]
        # Along what is next to each other in memory: across the channels it takes half as long as the network.
        channels = np.ascontiguousarray(image.reshape(-1, 3).T)
        if int(channels.max()) < _DARK or float(channels.std(axis=1, dtype=np.float32).max()) < _FLAT:
            raise PerceptionError(f"the camera {self.camera!r} shows nothing: its image has one colour only")
        values = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(self._device).float() / 255
        with use_threads(self._threads):
            found = self._policy.detect(values)[0]
        return _objects(found, self._least)


def _objects(found: "Detections", least: float) -> list[PerceivedObject]:
    """Return what was found, each as what it most likely is, with the alternatives that are at least so certain."""
    objects = []
    for place in range(len(found.presence)):
        box = float(found.is_box[place])
        kinds: tuple[tuple[Literal["cup", "box"], float], ...] = (("box", box), ("cup", 1 - box))
        names = [
            (float(found.presence[place]) * likely * share, kind, colour)
            for kind, likely in kinds
            for colour, share in zip(COLOURS.values(), found.colour[place].tolist(), strict=True)
        ]
        first, *others = [_object(found, place, *name) for name in sorted(names, reverse=True)]
        likely_others = tuple(one for one in others if one.certainty >= least)
        objects.append(replace(first, alternatives=likely_others))
    return objects


def _object(
    found: "Detections", place: int, certainty: float, kind: Literal["cup", "box"], colour: tuple[float, float, float]
) -> PerceivedObject:
    length, width, height = found.size[place].tolist()
    if kind == "cup":
        length = width = (length + width) / 2
    x, y, z = found.position[place].tolist()
    scale = float(found.scale[place])
    return PerceivedObject(
        index=place,
        kind=kind,
        position=(x, y, z),
        yaw=float(found.yaw[place]) if kind == "box" else 0.0,
        size=(length, width, height),
        colour=colour,
        target=False,
        error_50_m=_RADIUS_50 * scale,
        error_90_m=_RADIUS_90 * scale,
        certainty=certainty,
    )
