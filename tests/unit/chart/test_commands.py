"""What pages tell to type of Helm, Docker and our own scripts: values that the chart has, the present version, files that are there."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from scripts import release_images
from tests.support.chart import SET_IMAGES
from tests.support.pages import PAGES, REPOSITORY, page_name, typed
from understudy import __version__

ALONE, WITH_ONE = {"--install", "--create-namespace", "--wait", "--reuse-values"}, {"--namespace", "--timeout"}
"""Options of installing that rendering has no use for, without a value and with one."""


def helms() -> Iterator[Any]:
    """Each command that installs or upgrades the chart."""
    for page in PAGES:
        for line in typed(page):
            if re.match(r"helm (install|upgrade) ", line):
                yield pytest.param(line, id=f"{page_name(page)}-{line[:30]}")


def rendering(line: str) -> list[str]:
    """Returns the arguments with which ``helm template`` renders what a command installs."""
    words = iter(shlex.split(line.replace("$REGISTRY", "registry.example"), comments=True)[2:])
    kept = []
    for word in words:
        if word in WITH_ONE:
            next(words)
        elif word not in ALONE:
            kept.append(word)
        elif word == "--reuse-values":
            kept += ["--set", f"allNamespaces=true,{SET_IMAGES}"]
    return kept


@pytest.fixture
def released(tmp_path: Path) -> Path:
    """What scripts/release prints, in the file to which the pages redirect it."""
    file = tmp_path / "images.yaml"
    digests = dict.fromkeys(release_images.CHART, f"sha256:{'1' * 64}")
    file.write_text(release_images.values("registry.example/understudy", digests))
    return file


@pytest.mark.parametrize("line", list(helms()))
def test_documented_helm_commands_set_the_documented_values(helm: str, released: Path, line: str) -> None:
    arguments = [str(released) if word == released.name else word for word in rendering(line)]
    command = [helm, "template", *arguments, "--kube-version", "1.34"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    objects = [item for item in yaml.safe_load_all(done.stdout) if item]
    (operator,) = (item for item in objects if item["kind"] == "Deployment")
    (container,) = operator["spec"]["template"]["spec"]["containers"]
    set_to = dict(word.split("=", 1) for word in ",".join(arguments).split(",") if word.startswith("images."))
    if str(released) in arguments:
        assert re.fullmatch(r"registry.example/understudy/operator:\S+@sha256:1{64}", container["image"])
    if repository := set_to.get("images.operator.repository"):
        assert container["image"].startswith(f"{repository}:")


def test_the_pages_contain_helm_commands() -> None:
    assert len(list(helms())) >= 6


def test_an_unknown_value_is_refused(helm: str) -> None:
    line = "helm install understudy charts/understudy --set allNamespaces=true,monitors.rollout=10"
    done = subprocess.run(
        [helm, "template", *rendering(line)], cwd=REPOSITORY, capture_output=True, text=True, timeout=60
    )
    assert done.returncode != 0
    assert "'rollout' not allowed" in done.stderr


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_documented_images_have_the_present_version(page: Any) -> None:
    tags = re.findall(r"understudy[-/](?:operator|monitor|\$\w+):(\d[\w.]*)", page.read_text())
    assert set(tags) <= {__version__}


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_documented_scripts_and_files_exist(page: Any) -> None:
    for line in typed(page):
        words = shlex.split(line.partition("<<")[0], comments=True) if line.count("'") % 2 == 0 else line.split()
        if not words:
            continue
        if words[0].startswith("scripts/"):
            assert (REPOSITORY / words[0]).is_file(), line
            assert words[0] != "scripts/bench" or (REPOSITORY / "bench" / f"{words[1]}.py").is_file(), line
        for word in words:
            if word.startswith(("examples/", "charts/")):
                assert (REPOSITORY / word).exists(), line
