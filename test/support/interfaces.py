"""Python modules of the ROS interfaces that have no wheel: control_msgs and tf2_msgs.

The definitions beside this file have the fields of the public packages of ROS 2 Jazzy
(ros-controls/control_msgs, ros2/geometry2). The generators come with the wheels; the code that
they write is compiled with the machine's C and C++ compilers:

    python -m test.support.interfaces FOLDER
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
from typing import Any

DEFINITIONS = Path(__file__).with_name('interface_definitions')
PACKAGES = ('control_msgs', 'tf2_msgs')
#: packages whose types the definitions contain
DEPENDENCIES = (
    'action_msgs',
    'builtin_interfaces',
    'geometry_msgs',
    'service_msgs',
    'std_msgs',
    'trajectory_msgs',
    'unique_identifier_msgs',
)
#: kinds of libraries that each package of interfaces has
LIBRARIES = (
    'rosidl_generator_c',
    'rosidl_generator_py',
    'rosidl_typesupport_c',
    'rosidl_typesupport_fastrtps_c',
    'rosidl_typesupport_introspection_c',
)
RUNTIMES = (
    'fastcdr',
    'rcutils',
    'rosidl_runtime_c',
    'rosidl_typesupport_c',
    'rosidl_typesupport_fastrtps_c',
    'rosidl_typesupport_fastrtps_cpp',
    'rosidl_typesupport_introspection_c',
)
FAST_CDR, INTROSPECTION = 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c'


def obstacle() -> str:
    """Return why the interfaces cannot be built here; empty if they can."""
    missing = [name for name in ('gcc', 'g++') if shutil.which(name) is None]
    if missing:
        return f'no {" and no ".join(missing)}'
    if find_spec('rosidl_generator_py') is None:
        return 'no rosidl_generator_py: rclpy is not installed from wheels'
    headers = Path(sysconfig.get_paths()['include']) / 'Python.h'
    return '' if headers.is_file() else f"no Python headers: '{headers}'"


@dataclass(frozen=True, kw_only=True)
class Build:
    """Folders of one package's build.

    Attributes:
        package: name of the package.
        prefix: where ROS is installed.
        python: folder that gets the Python package.
        work: folder for generated C code.
    """

    package: str
    prefix: Path
    python: Path
    work: Path

    @property
    def module(self) -> Path:
        """Folder of the Python package."""
        return self.python / self.package

    def translate(self) -> list[str]:
        """Return the definitions as IDL files, in the notation of the generators."""
        from rosidl_adapter.action import convert_action_to_idl
        from rosidl_adapter.msg import convert_msg_to_idl

        converters = {'.msg': convert_msg_to_idl, '.action': convert_action_to_idl}
        root = self.work / 'share' / self.package
        shutil.copytree(DEFINITIONS / self.package, root)
        found = []
        for path in sorted(p.relative_to(root) for p in root.rglob('*.*')):
            converters[path.suffix](root, self.package, path, root / path.parent)
            found.append(f'{root}:{path.with_suffix(".idl")}')
        return found

    def compile(self, library: str, sources: Iterable[Any], *options: str) -> None:
        """Compile sources to a shared library that finds those beside it."""
        objects = []
        for source in map(Path, sources):
            if source.suffix in ('.c', '.cpp'):
                objects.append(f'{source}.o')
                compiler = ['gcc'] if source.suffix == '.c' else ['g++', '-std=c++17']
                command = [*compiler, '-c', '-fPIC', '-O0', '-w', *self._includes()]
                subprocess.run([*command, str(source), '-o', objects[-1]], check=True)
        links = [f'-L{self.module}', f'-L{self.prefix / "lib"}']
        paths = [f'-Wl,-soname,{library}', f'-Wl,-rpath,$ORIGIN:{self.prefix / "lib"}']
        command = ['g++', '-shared', '-Wl,--no-as-needed', '-o', str(self.module / library)]
        subprocess.run(
            [*command, *objects, *paths, *links, *options, *self._dependencies()], check=True
        )

    def _includes(self) -> list[str]:
        import numpy as np

        installed = self.prefix / 'include'
        folders = [*sorted(self.work.glob('rosidl_*')), self.python, installed]
        folders += [path for path in sorted(installed.iterdir()) if path.is_dir()]
        folders += [Path(np.get_include()), Path(sysconfig.get_paths()['include'])]
        return [f'-I{folder}' for folder in folders]

    def _dependencies(self) -> list[str]:
        names = [f'{package}__{kind}' for package in DEPENDENCIES for kind in LIBRARIES]
        found = [name for name in names if (self.prefix / f'lib/lib{name}.so').is_file()]
        return [f'-l{name}' for name in (*found, *RUNTIMES)]


def build_package(build: Build) -> None:
    """Generate and compile the C and Python code of one package."""
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    package, definitions = build.package, build.translate()
    supports = [FAST_CDR, INTROSPECTION]

    def generate(make: Callable[[str], Any], name: str) -> list[Any]:
        # a folder each: two generators write files of one name
        return make(name).generate(
            package_name=package,
            interface_files=definitions,
            include_paths=[str(build.prefix / 'share' / name) for name in DEPENDENCIES],
            output_path=build.module if name == 'python' else build.work / name / package,
        )

    dispatch = partial(GenerateCTypesupport, typesupport_implementations=supports)
    python = partial(GeneratePython, typesupport_implementations=['rosidl_typesupport_c'])
    structs = generate(GenerateC, 'rosidl_generator_c')
    structs += generate(dispatch, 'rosidl_typesupport_c')
    fast_cdr = generate(GenerateFastRTPSCTypesupport, FAST_CDR)
    introspection = generate(GenerateIntrospectionCTypesupport, INTROSPECTION)
    extension = generate(python, 'python')
    for folder in {build.module, *(Path(path).parent for path in extension)}:
        (folder / '__init__.py').touch()

    generated = f'{package}__rosidl_generator_c'
    build.compile(f'lib{generated}.so', structs)
    build.compile(f'lib{package}__{FAST_CDR}.so', fast_cdr, f'-l{generated}')
    build.compile(f'lib{package}__{INTROSPECTION}.so', introspection, f'-l{generated}')
    suffix = sysconfig.get_config_var('EXT_SUFFIX')
    beside = [f'-l{name}' for name in (generated, *(f'{package}__{kind}' for kind in supports))]
    build.compile(f'{package}_s__rosidl_typesupport_c{suffix}', extension, *beside)


def build_interfaces(folder: Path) -> None:
    """Build the interfaces into a folder that replaces what was there."""
    prefix = Path(sys.prefix)
    os.environ['AMENT_PREFIX_PATH'] = str(prefix)  # where the generators look for their templates
    partial_folder = folder.with_name(f'{folder.name}.partial')
    shutil.rmtree(partial_folder, ignore_errors=True)
    work = partial_folder / 'generated'
    for package in PACKAGES:
        python = partial_folder / 'python'
        with redirect_stdout(sys.stderr):  # the converters name every file
            build_package(
                Build(package=package, prefix=prefix, python=python, work=work / package)
            )
    shutil.rmtree(folder, ignore_errors=True)
    (partial_folder / 'python').rename(folder)
    shutil.rmtree(partial_folder)


def main() -> int:
    """Build into the folder of the command line, or say why not; what is missing is no error."""
    folder = Path(sys.argv[1])
    reason = obstacle()
    if reason:
        print(f'control_msgs and tf2_msgs are not built: {reason}', file=sys.stderr)
        return 0
    build_interfaces(folder.resolve())
    return 0


if __name__ == '__main__':
    sys.exit(main())
