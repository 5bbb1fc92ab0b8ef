"""Installers read the dependencies before they build a wheel, and an index shows working links."""

import os
import re
import runpy
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOOKS = ROOT / "scripts" / "build_wheel.py"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NEEDED = PROJECT["tool"]["hatch"]["metadata"]["hooks"]["custom"]["dependencies"]
COMPILE = PROJECT["project"]["optional-dependencies"]["compile"]


@pytest.fixture
def metadata(monkeypatch):
    """Return the metadata that hatchling computes, for variables of the environment."""
    pytest.importorskip("hatchling")
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    def computed(**variables):
        for name in ("QUAD_GYM_WHEEL", "QUAD_GYM_URL"):
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        return ProjectMetadata(str(ROOT), PluginManager()).core

    return computed


def test_only_wheels_with_compiled_kernels_do_without_numba(metadata):
    def normal(requirements):
        return sorted(re.sub(r"[<>=].*", "", requirement) for requirement in requirements)

    assert normal(metadata().dependencies) == normal([*NEEDED, *COMPILE])
    assert normal(metadata(QUAD_GYM_WHEEL="x86_64").dependencies) == normal(NEEDED)


def test_links_are_absolute_where_a_release_names_the_repository(metadata):
    assert metadata().urls == {}
    found = metadata(QUAD_GYM_URL="https://example.org/us/it/")
    assert found.urls["Source"] == "https://example.org/us/it"
    links = re.findall(r"\]\(([^)\s]+)\)", found.readme)
    assert all(link.startswith("https://") for link in links)
    ours = [link for link in links if link.startswith("https://example.org/us/it/")]
    of_files = [link for link in ours if "/blob/" in link or "/raw/" in link]
    assert len(links) > 20
    assert of_files
    assert set(ours) - set(of_files) == {
        "https://example.org/us/it/actions/workflows/tests.yml",
        "https://example.org/us/it/actions/workflows/tests.yml/badge.svg",
        "https://example.org/us/it/issues",
    }
    for link in of_files:
        place = link.removeprefix("https://example.org/us/it/").partition("/v")
        kind, path = place[0], place[2].partition("/")[2].partition("#")[0]
        assert kind == ("raw" if path.endswith(".webp") else "blob"), link
        assert (ROOT / path).exists(), link


def test_links_elsewhere_and_within_the_page_are_kept():
    pytest.importorskip("hatchling")
    absolute = runpy.run_path(str(HOOKS))["absolute_links"]
    text = "[a](https://a.org/b) [c](#d) [e](f.md#g) [![h](i.png)](j.md)"
    assert absolute(text, "https://p/", "https://q/") == (
        "[a](https://a.org/b) [c](#d) [e](https://p/f.md#g) [![h](https://q/i.png)](https://p/j.md)"
    )


@pytest.mark.skipif(shutil.which("bash") is None, reason="the workflow runs in bash")
@pytest.mark.parametrize("tag", ["v0.1.0", "v0.1", "v0.1.0rc1", "v0.2.0"])
def test_a_release_takes_only_the_tag_of_its_version(tag, tmp_path):
    workflow = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    step = re.search(r"The tag is the version of every file\n +run: \|\n((?: {10}.+\n)+)", workflow)
    (tmp_path / "dist").mkdir()
    for end in (".tar.gz", "-py3-none-any.whl", "-py3-none-manylinux_2_17_x86_64.whl"):
        (tmp_path / "dist" / f"quad_gym-0.1.0{end}").touch()
    variables = os.environ | {"GITHUB_REF_NAME": tag}
    command = ["bash", "-e", "-c", step[1]]
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, check=False)
    assert (done.returncode == 0) == (tag == "v0.1.0"), done.stderr


@pytest.mark.slow  # builds in an environment with packages from the index
@pytest.mark.parametrize("source", ["clone", "git", "sdist"])
def test_uv_resolves_all_dependencies(source, tmp_path):
    uv = shutil.which("uv")
    if uv is None:
        pytest.skip("this needs uv: pip install uv")
    address = ROOT.as_uri()
    if source == "git":
        if not (ROOT / ".git").exists():
            pytest.skip("this is no clone")
        address = f"git+{address}"
    if source == "sdist":
        build = [uv, "build", "--quiet", "--sdist", "--out-dir", str(tmp_path), str(ROOT)]
        subprocess.run(build, check=True)
        address = next(tmp_path.glob("*.tar.gz")).as_uri()
    done = subprocess.run(
        [uv, "pip", "compile", "--quiet", "-"],
        input=f"quad-gym @ {address}",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = {line.partition("==")[0] for line in done.stdout.splitlines() if "==" in line}
    assert {re.split("[<>=]", name)[0] for name in (*NEEDED, *COMPILE)} <= found
