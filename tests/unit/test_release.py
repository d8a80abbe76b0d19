"""A release is built from a commit, on a base image that its digest names, and its images say so."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from scripts import release_images
from testcluster.paths import REPOSITORY

BASE = "sha256:" + "1" * 64
BUILT = "sha256:" + "2" * 64
COMMIT = "c" * 40

DOCKER = f"""#!{sys.executable}
import json, os, sys
from pathlib import Path
words = sys.argv[1:]
state = Path(os.environ["STATE"])
with (state / "calls").open("a") as calls:
    print(json.dumps(words), file=calls)
if words[0] == "build":
    labels = dict(words[i + 1].split("=", 1) for i, word in enumerate(words) if word == "--label")
    (state / "labels").write_text(json.dumps(labels))
elif words[:2] == ["image", "inspect"]:
    print("null" if (state / "no-labels").exists() else (state / "labels").read_text())
elif words[0] == "push":
    print("0.2.0: digest: {BUILT} size: 1234")
elif words[0] == "buildx":
    if (state / "no-registry").exists():
        sys.exit("no route to host")
    else:
        print((state / "base").read_text() if (state / "base").exists() else "{BASE}")
"""


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that changes how the stand-in for Docker behaves, and in which it records its calls."""
    (tmp_path / "bin").mkdir()
    docker = tmp_path / "bin" / "docker"
    docker.write_text(DOCKER)
    docker.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:/usr/bin:/bin")
    monkeypatch.setenv("STATE", str(tmp_path))
    monkeypatch.setattr(release_images, "commit", lambda: COMMIT)
    return tmp_path


def calls(state: Path, verb: str) -> list[list[str]]:
    """The calls of Docker with a verb."""
    file = state / "calls"
    found = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    return [words for words in found if words[0] == verb]


def test_every_image_is_built_on_the_digest_that_the_registry_has_and_says_so(state: Path) -> None:
    assert release_images.main(["registry.example/understudy"]) == 0
    built = calls(state, "build")
    assert [words[words.index("--target") + 1] for words in built] == ["operator", "monitor", "tracker"]
    for words in built:
        assert f"BASE_IMAGE=python:3.12-slim@{BASE}" in words
        assert f"org.opencontainers.image.base.digest={BASE}" in words
        assert "org.opencontainers.image.base.name=python:3.12-slim" in words
        assert f"org.opencontainers.image.revision={COMMIT}" in words
        assert f"org.opencontainers.image.version={release_images.version()}" in words


def test_it_prints_values_of_the_chart_with_the_digests_of_what_was_pushed(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert release_images.main(["registry.example/understudy"]) == 0
    tag = release_images.version()
    pushed = [words[1] for words in calls(state, "push")]
    assert pushed == [f"registry.example/understudy/{name}:{tag}" for name in ("operator", "monitor", "tracker")]
    values = yaml.safe_load(capsys.readouterr().out)
    assert values["images"]["monitor"] == {"repository": "registry.example/understudy/monitor", "digest": BUILT}
    known = yaml.safe_load((REPOSITORY / "charts" / "understudy" / "values.yaml").read_text())["images"]
    for name, image in values["images"].items():
        assert image.keys() <= known[name].keys(), "the chart knows these values"


def test_a_base_image_can_be_given_with_its_digest(state: Path) -> None:
    (state / "no-registry").touch()
    assert release_images.main(["registry.example/understudy", "--base", f"mirror.example/python:3.12@{BASE}"]) == 0
    assert all(f"BASE_IMAGE=mirror.example/python:3.12@{BASE}" in words for words in calls(state, "build"))


@pytest.mark.parametrize("base", ["python:3.12-slim", "python@sha256:123", f"python@{BASE}0", f"@{BASE}"])
def test_a_base_image_without_a_digest_is_refused(state: Path, base: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert release_images.main(["registry.example/understudy", "--base", base]) == 1
    assert "digest" in capsys.readouterr().err
    assert not calls(state, "build")


@pytest.mark.parametrize("answer", ["no-registry", "base"])
def test_nothing_is_built_if_the_digest_cannot_be_found_out(
    state: Path, answer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (state / answer).write_text("<none>")
    assert release_images.main(["registry.example/understudy"]) == 1
    assert "digest of python:3.12-slim" in capsys.readouterr().err
    assert not calls(state, "build")


def test_an_image_that_does_not_say_what_it_was_built_on_is_not_pushed(
    state: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (state / "no-labels").touch()
    assert release_images.main(["registry.example/understudy"]) == 1
    assert "base.digest" in capsys.readouterr().err
    assert not calls(state, "push")


@pytest.mark.parametrize(
    ("path", "allowed"),
    [("images.yaml", True), ("Dockerfile", False), ("constraints.txt", False), ("operator/understudy/new.py", False)],
)
def test_a_release_is_built_from_a_commit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str, allowed: bool
) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=Somebody", "-c", "user.email=somebody@example.org"]
    subprocess.run([*git[:3], "init", "--quiet"], check=True)
    (tmp_path / "operator" / "understudy").mkdir(parents=True)
    for name in ("Dockerfile", "constraints.txt"):
        (tmp_path / name).write_text("committed\n")
    subprocess.run([*git, "add", "."], check=True)
    subprocess.run([*git, "commit", "--quiet", "--message", "all"], check=True)
    monkeypatch.setattr(release_images, "REPOSITORY", tmp_path)
    committed = release_images.commit()
    assert re.fullmatch("[0-9a-f]{40}", committed)
    (tmp_path / path).write_text("changed\n")
    if allowed:
        assert release_images.commit() == committed
    else:
        with pytest.raises(release_images.Refused, match=path.partition("/")[0]):
            release_images.commit()


def test_nothing_but_the_base_image_comes_from_a_registry() -> None:
    """So the digest of the base image decides what is below our own layers."""
    for file in (REPOSITORY / "Dockerfile", *REPOSITORY.glob("examples/*/Dockerfile")):
        text = file.read_text()
        stages = set(re.findall(r"^FROM \S+ AS (\S+)$", text, re.MULTILINE))
        allowed = {"${BASE_IMAGE}", "${DEPENDENCIES_IMAGE}", *stages}
        assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) <= allowed, file
        assert set(re.findall(r"--from=(\S+)", text)) <= stages, file
        assert "ARG DEPENDENCIES_IMAGE=${BASE_IMAGE}\n" in text or "DEPENDENCIES_IMAGE" not in text, file
        assert not re.search(r"^# *syntax=", text, re.MULTILINE), "a frontend would be fetched by its tag"
