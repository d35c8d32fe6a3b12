"""Generate and compile the Python type support of message packages, with ROS's own generators and a C++ compiler.

    ROS_PYTHON build_messages.py OUT NAME=FOLDER…

FOLDER/msg holds the .msg files of NAME. Afterwards OUT belongs on PYTHONPATH, and OUT/lib on LD_LIBRARY_PATH.
"""

import json
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy
import rosidl_generator_c
import rosidl_generator_py
import rosidl_generator_type_description
import rosidl_typesupport_c
import rosidl_typesupport_fastrtps_c
import rosidl_typesupport_introspection_c
from rosidl_adapter.msg import convert_msg_to_idl

PREFIX = Path(sys.prefix)
DEPENDENCIES = ("std_msgs", "geometry_msgs", "builtin_interfaces")
# What rmw_fastrtps_cpp reads: the one it serialises with, and in Jazzy the one it describes types with.
TYPE_SUPPORTS = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]


def generate(name: str, source: Path, out: Path) -> None:
    """Write the C, C++ and Python sources of one package into `out`."""
    stems = sorted(path.stem for path in (source / "msg").glob("*.msg"))
    for stem in stems:
        convert_msg_to_idl(source, name, Path("msg", f"{stem}.msg"), out / "msg")

    def arguments(generator: str) -> str:
        path = out / f"{generator}.json"
        templates = PREFIX / "share" / generator / "resource"
        path.write_text(
            json.dumps(
                {
                    "package_name": name,
                    "output_dir": str(out),
                    "template_dir": str(templates),
                    "idl_tuples": [f"{out}:msg/{stem}.idl" for stem in stems],
                    "ros_interface_files": [f"{out}/msg/{stem}.idl" for stem in stems],
                    "ros_interface_dependencies": [
                        f"{one}:{idl}" for one in DEPENDENCIES for idl in (PREFIX / "share" / one / "msg").glob("*.idl")
                    ],
                    "type_description_tuples": [f"msg/{stem}.idl:{out}/msg/{stem}.json" for stem in stems],
                    "include_paths": [f"{one}:{PREFIX / 'share' / one}" for one in DEPENDENCIES],
                    "target_dependencies": [],
                }
            )
        )
        for header in templates.glob("*__visibility_control.h.in"):
            text = header.read_text().replace("@PROJECT_NAME@", name).replace("@PROJECT_NAME_UPPER@", name.upper())
            (out / "msg" / header.stem).write_text(text)
        return str(path)

    rosidl_generator_type_description.generate_type_hash(arguments("rosidl_generator_type_description"))
    rosidl_generator_c.generate_c(arguments("rosidl_generator_c"))
    rosidl_typesupport_fastrtps_c.generate_typesupport_fastrtps_c(arguments("rosidl_typesupport_fastrtps_c"))
    rosidl_typesupport_introspection_c.generate_c(arguments("rosidl_typesupport_introspection_c"))
    rosidl_typesupport_c.generate_c(arguments("rosidl_typesupport_c"), TYPE_SUPPORTS)
    rosidl_generator_py.generate_py(arguments("rosidl_generator_py"), ["rosidl_typesupport_c"])
    (out / "__init__.py").touch()


def compile_package(compiler: str, name: str, out: Path) -> None:
    """Compile one package into one library, and give it the names by which ROS looks for its parts."""
    library = out / f"{name}_s__rosidl_typesupport_c.so"
    includes = [out.parent, sysconfig.get_path("include"), numpy.get_include(), PREFIX / "include"]
    includes += [path for path in (PREFIX / "include").iterdir() if path.is_dir()]
    parts = ("rosidl_generator_py", "rosidl_generator_c", *TYPE_SUPPORTS)
    libraries = [f"{one}__{part}" for one in DEPENDENCIES for part in parts]
    libraries += ["rosidl_typesupport_c", "rosidl_typesupport_fastrtps_cpp", *TYPE_SUPPORTS]
    libraries += ["rosidl_runtime_c", "rcutils", "fastcdr", "stdc++"]
    command = [compiler, "-shared", "-fPIC", "-O1", "-w", "-Wl,--unresolved-symbols=ignore-all", "-o", str(library)]
    command += [f"-I{path}" for path in includes]
    command += [str(path) for pattern in ("*.c", "*.cpp") for path in sorted(out.rglob(pattern))]
    command += [f"-L{PREFIX / 'lib'}", *(f"-l{one}" for one in libraries)]
    subprocess.run(command, check=True)
    for part in ("rosidl_generator_c", "rosidl_typesupport_c", *TYPE_SUPPORTS):
        (out.parent / "lib" / f"lib{name}__{part}.so").symlink_to(f"../{name}/{library.name}")


def main() -> None:
    out = Path(sys.argv[1]).resolve()
    compiler = shutil.which("gcc") or sys.exit("there is no C++ compiler (Debian, Ubuntu: apt-get install g++)")
    if not Path(sysconfig.get_path("include"), "Python.h").exists():
        sys.exit(f"{sys.executable} has no Python.h (Debian, Ubuntu: apt-get install python3-dev)")
    (out / "lib").mkdir(parents=True)
    for package in sys.argv[2:]:
        name, _, source = package.partition("=")
        generate(name, Path(source).resolve(), out / name)
        compile_package(compiler, name, out / name)


if __name__ == "__main__":
    main()
