"""The package as installed: built by colcon, as a wheel, and through make."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

import body_tracking
from body_tracking import systems
from body_tracking.core.extras import pip_install
from body_tracking.pipeline import graph
from domains import domain

ROOT = Path(__file__).resolve().parent.parent
SHARED_FOLDERS = ("config", "launch", "rviz", "foxglove", "bags")

# import name -> (distribution, rosdep key); None where rosdistro has no key that fits and README.md gives the pip line.
# All other imports are ROS packages, declared under their own names.
LIBRARIES = {
    "numpy": ("numpy", "python3-numpy"),
    "scipy": ("scipy", "python3-scipy"),
    "cv2": ("opencv-python-headless", "python3-opencv"),
    "yaml": ("pyyaml", "python3-yaml"),
    "matplotlib": ("matplotlib", "python3-matplotlib"),
    "filterpy": ("filterpy", "python3-filterpy-pip"),
    "vqf": ("vqf", None),
    "numba": ("numba", None),
    "mcap": ("mcap", None),
    "lz4": ("lz4", None),
    "zstandard": ("zstandard", None),
    "rosbags": ("rosbags", None),
}
EXTRAS = {"ai_edge_litert": "camera", "viser": "viewer", "trimesh": "viewer", "websockets": "viewer"}
"""Import name -> extra; modules that import these name the extra where it is absent."""


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """The finished command; its output is in the failure message where it fails."""
    done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, f"{command} ended with {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done


def files_under(folder: Path) -> set[str]:
    """Relative paths of the files that a build ships from a folder of the project."""
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".") and "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project as a clone would be, so that builds leave nothing in the real one."""
    copy = tmp_path_factory.mktemp("workspace") / "src" / "body_tracking"
    wanted = ("body_tracking", "resource", "scripts", *SHARED_FOLDERS)
    skip = shutil.ignore_patterns("__pycache__", "*.pyc")
    for folder in wanted:
        if (ROOT / folder).is_dir():
            shutil.copytree(ROOT / folder, copy / folder, ignore=skip)
    for file in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE", "README.md"):
        shutil.copy(ROOT / file, copy)
    return copy


@pytest.fixture(scope="module")
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


@pytest.fixture(scope="module")
def node_names() -> set[str]:
    """The node files: one node, one file."""
    files = (ROOT / "body_tracking" / "nodes").glob("*.py")
    nodes = {path.stem for path in files if re.search(r"^(def )?main\b", path.read_text(), re.MULTILINE)}
    assert "fusion" in nodes
    return nodes


# --- the manifest


def test_package_xml_is_a_valid_format_3_manifest() -> None:
    package_format = pytest.importorskip("catkin_pkg.package")
    warnings: list[str] = []
    package = package_format.parse_package(str(ROOT), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3
    assert [export.content for export in package.exports if export.tagname == "build_type"] == ["ament_python"]
    assert all((ROOT / licence.file).is_file() for licence in package.licenses)


def test_version_is_the_same_everywhere(manifest: ElementTree.Element, wheel: Path) -> None:
    assert manifest.findtext("version") == body_tracking.__version__
    assert wheel.name.split("-")[1] == body_tracking.__version__
    changelog = pytest.importorskip("catkin_pkg.changelog").get_changelog_from_path(str(ROOT))
    version, date, _ = next(iter(changelog.foreach_version(reverse=True)))
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert version == citation["version"] == body_tracking.__version__
    assert date.date() == citation["date-released"]


def test_the_maintainer_is_the_same_everywhere() -> None:
    manifests = [ROOT / "package.xml", *(ROOT / "examples").rglob("package.xml")]
    people = [each for path in manifests for each in ElementTree.parse(path).iter("maintainer")]
    assert len(people) == len(manifests) > 1
    ((name, _),) = {(each.text, each.get("email")) for each in people}
    assert f'author="{name}"' in (ROOT / "setup.py").read_text()
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["authors"] == [{"name": name}]


def imports() -> Iterator[tuple[str, str]]:
    """(top-level module, where) of every import in the shipped Python files, those inside functions too."""
    for path in [*(ROOT / "body_tracking").rglob("*.py"), *(ROOT / "launch").glob("*.py")]:
        for statement in ast.walk(ast.parse(path.read_text())):
            if isinstance(statement, ast.Import):
                yield from ((name.name.split(".")[0], path.name) for name in statement.names)
            elif isinstance(statement, ast.ImportFrom) and statement.module:
                yield statement.module.split(".")[0], path.name


def test_every_import_is_a_declared_dependency(manifest: ElementTree.Element, wheel: Path) -> None:
    declared = {str(depend.text) for depend in manifest.iter("exec_depend")}
    with zipfile.ZipFile(wheel) as archive:
        metadata = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode()
    required = set(re.findall(r"^Requires-Dist: ([\w-]+)[^;\n]*$", text, re.MULTILINE))
    readme = (ROOT / "README.md").read_text()
    for module, where in set(imports()):
        if module in sys.stdlib_module_names or module == "body_tracking":
            continue
        if module in EXTRAS:
            extra = EXTRAS[module]
            name = module.replace("_", "-")
            assert re.search(rf"^Requires-Dist: {name}\b.*; extra == .{extra}.$", text, re.MULTILINE), "setup.py"
            assert f"[{extra}]" in readme, f"{extra}: no pip line in README.md"
            continue
        if module not in LIBRARIES:
            assert module in declared, f"{where} imports {module}: package.xml does not declare it"
            continue
        distribution, rosdep_key = LIBRARIES[module]
        assert distribution in {name.lower() for name in required}, f"{where} imports {module}: setup.py"
        if rosdep_key is None:
            assert re.search(rf"pip install .*\b{distribution}\b", readme), f"{distribution}: no pip line in README.md"
        else:
            assert rosdep_key in declared, f"{where} imports {module}: package.xml does not declare {rosdep_key}"


def test_messages_name_the_libraries_of_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    assert pip_install("c3d") == "pip install 'ezc3d>=1.7'"

    def lacking(name: str) -> list[str]:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("body_tracking.core.extras.requires", lacking)
    assert pip_install("c3d") == "pip install -e '.[c3d]'"


# --- the wheel


@pytest.fixture(scope="module")
def wheel(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as pip does it, without its download of the build tools."""
    folder = tmp_path_factory.mktemp("wheel")
    done = run(
        sys.executable,
        *("-W", "always", "-c", "import sys, setuptools.build_meta as b; b.build_wheel(sys.argv[1])", folder),
        cwd=project,
    )
    assert "Deprecat" not in done.stdout + done.stderr, done.stderr
    return next(folder.glob("*.whl"))


def test_wheel_installs_all_modules_and_share_files(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        # pip's own commands are the only ones in it
        assert not [name for name in archive.namelist() if ".data/data/bin/" in name]
    target = tmp_path / "target"
    pip = ("-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile", "--target", target, wheel)
    run(sys.executable, *pip, cwd=tmp_path)
    modules = {path for path in files_under(ROOT / "body_tracking") if path.endswith((".py", "py.typed"))}
    assert {"py.typed"} < modules <= files_under(target / "body_tracking")
    check_shared(target / "share" / "body_tracking")


def check_shared(share: Path) -> None:
    for folder in SHARED_FOLDERS:
        assert files_under(share / folder) == files_under(ROOT / folder), folder


@pytest.mark.slow
def test_sdist_and_the_wheel_from_it_play_a_shipped_recording(tmp_path: Path) -> None:
    """As a user has it: built by ``python -m build``, which makes the wheel from the sdist, and installed anew."""
    pytest.importorskip("rclpy")
    pytest.importorskip("build")
    clone = tmp_path / "clone"
    files = run("git", "ls-files", "-z", cwd=ROOT).stdout.split("\0")
    for name in filter(None, files):
        (clone / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, clone / name)
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path / "dist", clone, cwd=tmp_path)
    (sdist,) = (tmp_path / "dist").glob("*.tar.gz")
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert {"CHANGELOG.rst", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "README.md"} <= packed
    # An environment of its own, with the libraries of this one behind what is installed into it.
    environment = tmp_path / "environment"
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=tmp_path)
    (site,) = environment.glob("lib/python3*/site-packages")
    run(sys.executable, "-m", "pip", "--python", environment / "bin" / "python", "install", "--quiet", "--no-index",
        "--no-deps", wheel, cwd=tmp_path)  # fmt: skip
    (site / "libraries.pth").write_text("".join(f"{path}\n" for path in sys.path if path.endswith("-packages")))
    share = environment / "share" / "body_tracking"
    check_shared(share)
    command, recording = environment / "bin" / "body_tracking", tmp_path / "recording"
    domain_id = {"ROS_DOMAIN_ID": str(domain()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | domain_id
    bag = share / "bags" / "tpose_wave"
    run(command, "up", "--bag", bag, "--rate", "2", "--record", recording, cwd=tmp_path, env=env)
    assert "elbow_flexion_left" in run(command, "show", recording, cwd=tmp_path, env=env).stdout
    where = "import body_tracking; print(body_tracking.__file__)"
    assert run(environment / "bin" / "python", "-c", where, cwd=tmp_path, env=env).stdout.startswith(str(site))


# --- colcon


@pytest.fixture(scope="module")
def prefix(project: Path) -> Path:
    """``install/body_tracking`` of a workspace built with ``colcon build``."""
    pytest.importorskip("colcon_core")
    workspace = project.parent.parent
    run(sys.executable, *("-m", "colcon", "build", "--event-handlers", "console_direct+"), cwd=workspace)
    return workspace / "install" / "body_tracking"


def test_colcon_installs_an_executable_per_node_of_the_table_and_what_ros_finds_packages_by(
    prefix: Path, node_names: set[str]
) -> None:
    assert set(systems.EXECUTABLES) == node_names
    executables = {path.name for path in (prefix / "lib" / "body_tracking").iterdir() if os.access(path, os.X_OK)}
    assert executables == node_names | {"body_tracking", "kinect_sender"}
    assert (prefix / "share" / "ament_index" / "resource_index" / "packages" / "body_tracking").is_file()
    share = prefix / "share" / "body_tracking"
    assert (share / "package.xml").read_text() == (ROOT / "package.xml").read_text()
    check_shared(share)


def in_workspace(prefix: Path, command: str) -> str:
    """The output of a shell command in the sourced workspace, run with the Python that built it."""
    env = dict(os.environ, PATH=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    setup = prefix.parent / "setup.sh"
    return run("sh", "-c", f'. "{setup}" && {command}', cwd=prefix.parent, env=env).stdout


def test_installed_nodes_load_from_the_install_prefix(prefix: Path, node_names: set[str]) -> None:
    pytest.importorskip("rclpy")
    module = "body_tracking.nodes."
    lines = "; ".join(f"import {module}{name} as n; print(n.__file__, callable(n.main))" for name in node_names)
    loaded = in_workspace(prefix, f'python -c "{lines}"').splitlines()
    assert len(loaded) == len(node_names)
    assert all(line.startswith(str(prefix)) and line.endswith("True") for line in loaded), loaded


def test_commands_are_on_the_path_of_a_sourced_workspace(prefix: Path) -> None:
    out = in_workspace(
        prefix, "command -v body_tracking && command -v kinect_sender && body_tracking --help && kinect_sender --help"
    )
    assert out.splitlines()[:2] == [str(prefix / "bin" / name) for name in ("body_tracking", "kinect_sender")]
    assert {"import", "replay", "up", "calibrate", "HOST"} <= set(re.findall(r"\w+", out))


# --- make and CI


def test_make_leaves_other_environments_behind(tmp_path: Path) -> None:
    """The mark of another environment's ROS wheels and a sourced ROS install must not reach this one's Python."""
    makefile = tmp_path / "probe.mk"
    makefile.write_text(f"include {ROOT}/Makefile\nprobe:\n\t@env\n")
    env = {
        "PATH": os.environ["PATH"],
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",
        "LD_LIBRARY_PATH": "/venv/lib/python3.11/site-packages/ros_rcl.libs:/opt/ros/jazzy/lib:/usr/local/lib",
        "PYTHONPATH": "/opt/ros/jazzy/lib/python3.12/site-packages",
        "ROS_DOMAIN_ID": "0",
    }
    for _ in range(3):
        printed = run("make", "-f", makefile, "probe", cwd=ROOT, env=env).stdout.split("\n")
        seen = dict(line.split("=", 1) for line in printed if "=" in line)
        assert not {"_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH"} & seen.keys()
        assert seen["LD_LIBRARY_PATH"] == "/usr/local/lib"
        assert seen["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
        assert 1 <= int(seen["ROS_DOMAIN_ID"]) <= 100


def test_make_setup_says_what_pip_does_and_why_it_failed(tmp_path: Path) -> None:
    """pip prints some hundred lines, or none; a user waits a minute or more."""
    log, script = tmp_path / "pip.log", ROOT / "scripts" / "pip_install.py"
    failed = subprocess.run(
        [sys.executable, script, log, "--no-index", "no-such-package-of-ours"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert failed.returncode == 1
    assert failed.stdout == f"collecting packages\npip failed; all that it printed is in {log}:\n"
    assert failed.stderr.startswith("ERROR: ") and failed.stderr in log.read_text()
    code = f"""import runpy
names = runpy.run_path({str(script)!r})
phases = names["Phases"](names["Line"]())
for text in (
    "Collecting scipy>=1.11 (from body_tracking==0.2.0)",
    "  Downloading scipy-1.17.0-cp311-cp311-manylinux_2_28_x86_64.whl (35.0 MB)",
    "Collecting tqdm",
    "  Downloading https://host/tqdm-4.70.1-py3-none-any.whl (580 kB)",
    "Installing collected packages: tqdm, scipy",
):
    phases.read(text)
phases.end()"""
    assert run(sys.executable, "-c", code, cwd=tmp_path).stdout == "installing 2 packages, 36 MB downloaded\n"


def test_ci_runs_make_test() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert "make test" in script.read_text()


# --- README.md and its picture


def test_readme_and_parameters_file_are_those_of_the_code() -> None:
    pytest.importorskip("rclpy")
    run(sys.executable, "docs/update.py", "--check", cwd=ROOT)


def test_the_table_of_benchmarks_lists_each_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ROOT / "benchmarks"
    monkeypatch.syspath_prepend(str(folder))
    import run as runner

    scripts = {path.stem for path in folder.glob("*.py") if '__name__ == "__main__"' in path.read_text()}
    assert scripts - {"run", "hosts"} == runner.BENCHMARKS.keys()  # hosts is a command of two_hosts


def test_a_benchmark_refuses_motions_in_which_nothing_is_hidden() -> None:
    words = [sys.executable, str(ROOT / "benchmarks" / "mesh_hidden.py"), "--seconds", "1"]
    done = subprocess.run(
        words, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2 and "--seconds 1: at least 1.5 are needed" in done.stderr


def test_picture_shows_every_node_and_topic() -> None:
    picture = ElementTree.parse(ROOT / "docs" / "graph.svg").getroot()
    texts = {element.text for element in picture.iter("{http://www.w3.org/2000/svg}text")}
    # The picture shows two sensors where the table has a pattern.
    topics = {topic.name.replace("<sensor>", "kinect1") for topic in systems.TOPICS} - {graph.TF, graph.TF_STATIC}
    assert set(systems.EXECUTABLES) | topics <= texts


def test_benchmarks_explain_themselves_without_what_they_need() -> None:
    """``estimators`` without the peers, and a name that is none."""

    def benchmark(*words: str) -> tuple[int, str, str]:
        command = [sys.executable, str(ROOT / "benchmarks" / "run.py"), *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)
        return done.returncode, done.stdout, done.stderr

    code, text, _ = benchmark("estimators", "--help")
    assert code == 0 and "--search" in text
    assert benchmark("mesh_fits") == (2, "", "no benchmark mesh_fits; did you mean 'mesh_fit'?\n")


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md", *(ROOT / "docs").glob("*.md")]


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as GitHub and mkdocs name them."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    plain = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in plain}


def test_links_in_the_documentation_lead_somewhere() -> None:
    for page in PAGES:
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\(([^)\s]+)\)", text):
            if "://" in link:
                continue
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), f"{page.name} links to {link}"
            if anchor:
                assert anchor in anchors(target), f"{page.name} links to {link}: no such heading"


def test_every_page_is_in_the_sites_navigation() -> None:
    listed = re.findall(r"- (?:\w+: )?(\w+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted({"index.md", *(page.name for page in (ROOT / "docs").glob("*.md"))})


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    mkdocs = ROOT / ".site_venv" / "bin" / "mkdocs"
    if not mkdocs.exists():
        pytest.skip("mkdocs is not installed: make site")
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = run(mkdocs, "build", "--strict", "--site-dir", tmp_path, cwd=ROOT, env=environment)
    assert "WARNING" not in done.stdout + done.stderr
    start = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "images/moving.webp" in start and (tmp_path / "images" / "moving.webp").is_file()


def test_a_module_over_500_lines_says_why() -> None:
    for path in (ROOT / "body_tracking").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if text.count("\n") > 500:
            assert "Over 500 lines: " in (ast.get_docstring(ast.parse(text)) or ""), path
