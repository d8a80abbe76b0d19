"""Bringing images to a containerd, which is here a script that writes down what it is asked for."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest

from testcluster.images import containerd, store
from tests.unit.testcluster.archives import archive, blobs

CTR = """\
#!/bin/sh
shift 2
echo "$*" >>"$0.log"
case "$1 $2" in
"images list") printf 'REF TYPE DIGEST\\n'; cat "$0.images" ;;
"content list") cat "$0.content" ;;
"images import")
    cp "$3" "$0.$(grep -c import "$0.log").tar"
    [ "$(grep -c import "$0.log")" -gt "$(cat "$0.failures")" ]
    ;;
esac
"""


@pytest.fixture
def ctr(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    program = tmp_path / "ctr"
    program.write_text(CTR)
    program.chmod(0o755)
    for name, text in (("images", ""), ("content", ""), ("failures", "0"), ("log", "")):
        (tmp_path / f"ctr.{name}").write_text(text)
    return program


def asked(ctr: Path) -> list[str]:
    return [line.split("/", 1)[0] for line in ctr.with_name("ctr.log").read_text().splitlines()]


def test_an_existing_image_is_not_imported_again(ctr: Path, tmp_path: Path) -> None:
    (image,) = store.add(archive(tmp_path / "image.tar", [b"code"]))
    ctr.with_name("ctr.images").write_text(f"{image.name} type {image.digest}\n")
    assert containerd.load([ctr], [image]) == []
    assert not [line for line in asked(ctr) if "import" in line]


def test_the_previous_image_is_kept_while_the_next_one_is_imported(ctr: Path, tmp_path: Path) -> None:
    (image,) = store.add(archive(tmp_path / "image.tar", [b"code"]))
    ctr.with_name("ctr.images").write_text(f"{image.name} type sha256:former\n")
    assert containerd.load([ctr], [image]) == [image]
    words = [line.split()[1] for line in asked(ctr)]
    assert words == ["list", "tag", "list", "import", "remove"]


def test_layers_that_were_garbage_collected_are_sent_again(ctr: Path, tmp_path: Path) -> None:
    (image,) = store.add(archive(tmp_path / "image.tar", [b"system", b"code"]))
    with store.archive([image], []) as whole:
        everything = blobs(whole)
    ctr.with_name("ctr.content").write_text("\n".join(everything))
    ctr.with_name("ctr.failures").write_text("1")
    assert containerd.load([ctr], [image]) == [image]
    assert blobs(ctr.with_name("ctr.1.tar")) == set()
    assert blobs(ctr.with_name("ctr.2.tar")) == everything
    assert tarfile.is_tarfile(ctr.with_name("ctr.2.tar"))
