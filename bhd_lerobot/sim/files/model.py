"""Models in files: MJCF, and URDF as MuJoCo reads it."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import ConfigError
from bhd_lerobot.sim.engine import mujoco

Array = NDArray[np.float64]

_CLASS = "robot_of_the_file"
_WITH_CLASS = (
    *("mesh", "material", "texture", "pair", "connect", "weld", "joint", "tendon", "flex", "fixed", "spatial"),
)


def load_model(path: str) -> Any:
    """Return the specification of a file, with the full paths of its meshes."""
    folder = Path(path).parent
    try:
        if Path(path).suffix == ".urdf" or "<robot" in Path(path).read_text(encoding="utf-8")[:4000]:
            return mujoco.MjSpec.from_string(_urdf(path))
        spec = mujoco.MjSpec.from_file(path)
    except ValueError as error:
        raise ConfigError(f"robot.mjcf is {path!r}, which MuJoCo cannot read: {error}") from error
    for files, where in ((spec.meshes, spec.meshdir), (spec.hfields, spec.meshdir), (spec.textures, spec.texturedir)):
        for one in files:
            if one.file:
                one.file = str(folder / where / (Path(one.file).name if spec.strippath else one.file))
    spec.meshdir, spec.texturedir, spec.strippath = "", "", False
    return spec


def _urdf(path: str) -> str:
    """Return a URDF for MuJoCo: with the full paths of its meshes, and with all its links."""
    text, folder = Path(path).read_text(encoding="utf-8"), Path(path).parent
    own = re.search(r"<mujoco\b.*?</mujoco>", text, re.DOTALL)
    folders = ("", *re.findall(r'\bmeshdir="([^"]*)"', own[0] if own else ""))

    def full(found: re.Match[str]) -> str:
        name = re.sub(r"^(package|model)://", "", found[1].removeprefix("file://"))
        places = [folder / name, *(above / name for above in folder.parents)]
        places += [above / name.partition("/")[2] for above in (folder, *folder.parents)]
        places += [folder / where / one for where in folders for one in (name, Path(name).name)]
        return f'filename="{next((one for one in places if one.is_file()), name)}"'

    text = re.sub(r'filename="([^"]+)"', full, text)
    how = '<mujoco><compiler strippath="false" discardvisual="true" fusestatic="false" balanceinertia="true"/></mujoco>'
    return text.replace(own[0], how) if own else re.sub(r"(<robot\b[^>]*>)", rf"\1{how}", text, count=1)


def joint_speeds(path: str) -> dict[str, float]:
    """Return the largest speeds of a URDF's joints [rad/s], which MuJoCo does not read."""
    found, text = {}, re.sub("<!--.*?-->", "", Path(path).read_text(encoding="utf-8"), flags=re.DOTALL)
    for joint in re.findall(r"<joint\b[^>]*[^/>]>.*?</joint>", text, re.DOTALL):
        # Of its limits: a safety controller has a `k_velocity`, which is none.
        speed = re.search(r'<limit\b[^>]*\bvelocity="([^"]+)"', joint)
        name = re.search(r'\bname="([^"]+)"', joint)
        if name and speed and float(speed[1]) > 0:
            found[name[1]] = float(speed[1])
    return found


def robot_alone(text: str, where: Array) -> str:
    """Return an MJCF with nothing but the robot, moved by a transform; its defaults are those of the robot alone."""
    tree = ElementTree.fromstring(text)
    for name in ("option", "visual", "statistic", "size", "custom"):
        for one in tree.findall(name):
            tree.remove(one)
    world = tree.find("worldbody")
    assert world is not None
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, where[:3, :3].reshape(-1))
    places = {"pos": where[:3, 3], "quat": quaternion}
    frame = ElementTree.Element("frame", {name: " ".join(map(repr, map(float, v))) for name, v in places.items()})
    for one in list(world):
        world.remove(one)
        frame.append(one)
    world.append(frame)
    for main in tree.findall("default"):
        own = ElementTree.Element("default", {"class": _CLASS})
        own.extend(list(main))
        main.clear()
        main.append(own)
        for one in tree.iter():
            for name in ("class", "childclass"):
                if one.get(name) == "main":
                    one.set(name, _CLASS)
        for section in ("asset", "contact", "equality", "tendon"):
            for one in tree.iterfind(f"{section}/*"):
                if one.tag in _WITH_CLASS:
                    one.set("class", one.get("class", _CLASS))
        frame.set("childclass", _CLASS)
    return ElementTree.tostring(tree, encoding="unicode")


def compiled(spec: Any, path: str) -> Any:
    """Return the compiled model of a specification."""
    try:
        return spec.compile()
    except ValueError as error:
        hint = " Files are looked for where it names them, beside it." if "file" in str(error) else ""
        raise ConfigError(f"The model {path!r} does not compile: {error}.{hint}") from error
