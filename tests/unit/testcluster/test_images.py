"""What decides whether an image is built anew, and what pip is told inside a build."""

from __future__ import annotations

import configparser
from pathlib import Path

import pytest

from testcluster.images import catalog, pip
from testcluster.images.catalog import Image


@pytest.fixture
def image(tmp_path: Path) -> Image:
    (tmp_path / "code" / "package").mkdir(parents=True)
    (tmp_path / "Dockerfile").write_text("ARG BASE_IMAGE=python:3.12-slim\n")
    (tmp_path / "code" / "package" / "module.py").write_text("")
    (tmp_path / "notes.txt").write_text("")
    return Image("localhost/understudy-thing:dev", tmp_path, None, ("Dockerfile", "code"))


def test_only_what_an_image_is_made_of_decides(image: Image) -> None:
    before = image.fingerprint("base")
    (image.context / "notes.txt").write_text("changed")
    (image.context / "code" / "__pycache__").mkdir()
    (image.context / "code" / "__pycache__" / "module.pyc").write_text("compiled")
    assert image.fingerprint("base") == before


@pytest.mark.parametrize("change", ["content", "name", "mode", "new", "base"])
def test_any_change_of_what_an_image_is_made_of_counts(image: Image, change: str) -> None:
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
