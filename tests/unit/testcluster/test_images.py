"""Which changes cause an image to be built again, and which settings pip has inside a build."""

from __future__ import annotations

import configparser
import subprocess
from pathlib import Path

import pytest

from testcluster.images import catalog, commits, pip
from testcluster.images.catalog import Image


@pytest.fixture
def image(tmp_path: Path) -> Image:
    (tmp_path / "code" / "package").mkdir(parents=True)
    (tmp_path / "Dockerfile").write_text("ARG BASE_IMAGE=python:3.12-slim\n")
    (tmp_path / "code" / "package" / "module.py").write_text("")
    (tmp_path / "notes.txt").write_text("")
    return Image("localhost/understudy-thing:dev", tmp_path, None, ("Dockerfile", "code"))


def test_the_tag_of_an_image_depends_only_on_its_sources(image: Image) -> None:
    before = image.fingerprint("base")
    (image.context / "notes.txt").write_text("changed")
    (image.context / "code" / "__pycache__").mkdir()
    (image.context / "code" / "__pycache__" / "module.pyc").write_text("compiled")
    assert image.fingerprint("base") == before


@pytest.mark.parametrize("change", ["content", "name", "mode", "new", "base"])
def test_any_change_of_its_sources_changes_the_tag_of_an_image(image: Image, change: str) -> None:
    before = image.fingerprint("base")
    module = image.context / "code" / "package" / "module.py"
    if change == "content":
        module.write_text("changed")
    elif change == "name":
        module.rename(module.with_name("other.py"))
    elif change == "mode":
        module.chmod(0o755)
    elif change == "new":
        module.with_name("other.py").touch()
    assert image.fingerprint("other" if change == "base" else "base") != before


def test_an_image_comes_after_the_one_it_is_built_on() -> None:
    known = {image.short: image for image in catalog.images()}
    assert {"operator", "monitor"} <= set(known)
    for image in known.values():
        names = [built.name for built in catalog.with_parents([image])]
        assert names[-1] == image.name
        assert image.parent is None or image.parent in names[:-1]


@pytest.fixture
def history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with two commits, which stands for this one, and a cache of its own."""
    repository = tmp_path / "repository"
    (repository / "examples" / "thing").mkdir(parents=True)
    git = ["git", "-C", str(repository), "-c", "user.name=Somebody", "-c", "user.email=somebody@example.org"]
    subprocess.run([*git[:3], "init", "--quiet"], check=True)
    for text in ("earlier", "later"):
        (repository / "Dockerfile").write_text(f"# {text}\n")
        (repository / "examples" / "thing" / "Dockerfile").write_text("ARG BASE_IMAGE=understudy/monitor\n")
        subprocess.run([*git, "add", "."], check=True)
        subprocess.run([*git, "commit", "--quiet", "--message", text], check=True)
    monkeypatch.setattr(commits, "REPOSITORY", repository)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return repository


def test_images_of_an_earlier_commit_are_built_from_its_files_and_have_a_tag_of_their_own(history: Path) -> None:
    source = commits.lay_out("HEAD^")
    assert (source.folder / "Dockerfile").read_text() == "# earlier\n"
    assert sorted(path.name for path in source.folder.iterdir()) == ["Dockerfile", "examples"]
    assert (history / "Dockerfile").read_text() == "# later\n"
    earlier = {image.short: image for image in catalog.images(source)}
    assert earlier["monitor"].name == f"localhost/understudy-monitor:{source.tag}"
    assert earlier["monitor"].context == source.folder
    assert earlier["thing"].parent == earlier["monitor"].name, "and not on the monitor's image of now"
    assert [image.tag for image in catalog.with_parents([earlier["thing"]], source)] == [source.tag] * 2
    assert {image.tag for image in catalog.images()} == {"dev"}


def test_a_commit_is_checked_out_once(history: Path) -> None:
    first = commits.lay_out("HEAD^")
    (first.folder / "mark").touch()
    assert commits.lay_out("HEAD^") == first
    assert (first.folder / "mark").exists()
    assert commits.lay_out("HEAD") != first


def test_a_commit_that_a_shallow_clone_lacks_is_reported(
    history: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = subprocess.run(["git", "-C", str(history), "rev-parse", "HEAD^"], capture_output=True, text=True, check=True)
    shallow = tmp_path / "shallow"
    subprocess.run(["git", "clone", "--quiet", "--depth=1", f"file://{history}", str(shallow)], check=True)
    monkeypatch.setattr(commits, "REPOSITORY", shallow)
    with pytest.raises(commits.NoSuchCommit, match="fetch --unshallow"):
        commits.lay_out(full.stdout.strip())


def test_a_dockerfile_without_a_base_argument_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "Dockerfile").write_text("FROM scratch\n")
    with pytest.raises(ValueError, match=r"Dockerfile: no line `ARG BASE_IMAGE"):
        catalog.base_argument(tmp_path / "Dockerfile")


def test_pip_in_a_build_gets_the_index_and_the_certificates_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    authorities = tmp_path / "authorities.pem"
    authorities.write_text("certificates")
    monkeypatch.setenv("PIP_INDEX_URL", "https://packages.example/simple")
    monkeypatch.setenv("PIP_CERT", str(authorities))
    monkeypatch.setenv("PIP_TARGET", "/somewhere")
    secrets = pip.secrets(tmp_path / "secrets")
    assert secrets["ca"] == authorities
    written = configparser.ConfigParser()
    written.read(secrets["pip"])
    assert written["global"]["index-url"] == "https://packages.example/simple"
    assert written["global"]["cert"] == "/run/secrets/ca"
    assert "target" not in written["global"]
    assert secrets["pip"].stat().st_mode & 0o077 == 0, "it may hold a password"
