"""Images taken apart into layers: each layer once, and archives of only what is missing."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path

import pytest

from testcluster.images import store
from tests.unit.testcluster.archives import archive, blobs, contents, digest


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_an_archive_for_a_node_that_has_nothing_holds_every_part(tmp_path: Path) -> None:
    (reference,) = store.add(archive(tmp_path / "image.tar", [b"system", b"code"]))
    with store.archive([reference], []) as path:
        found = contents(path)
        index = json.loads(found["index.json"])
        (entry,) = index["manifests"]
        assert entry["annotations"]["io.containerd.image.name"] == "localhost/thing:dev"
        manifest = json.loads(found["blobs/sha256/" + entry["digest"].removeprefix("sha256:")])
        parts = {manifest["config"]["digest"], *(layer["digest"] for layer in manifest["layers"])}
        assert blobs(path) == {entry["digest"], *parts}
        assert all(digest(found["blobs/sha256/" + part.removeprefix("sha256:")]) == part for part in parts)
    assert not path.exists()


def test_two_nodes_that_lack_the_same_layers_get_separate_archives(tmp_path: Path) -> None:
    (reference,) = store.add(archive(tmp_path / "image.tar", [b"system", b"code"]))
    with store.archive([reference], []) as first:
        with store.archive([reference], []) as second:
            assert first != second
        with tarfile.open(first) as whole:
            assert whole.getmembers()


def test_an_archive_omits_layers_that_the_node_has(tmp_path: Path) -> None:
    store.add(archive(tmp_path / "image.tar", [b"system", b"code"]))
    (changed,) = store.add(archive(tmp_path / "image.tar", [b"system", b"other code"]))
    with store.archive([changed], [digest(b"system"), digest(b"code")]) as path:
        assert digest(b"system") not in blobs(path)
        assert digest(b"other code") in blobs(path)


def test_a_name_refers_to_the_last_added_image(tmp_path: Path) -> None:
    store.add(archive(tmp_path / "image.tar", [b"code"]))
    (changed,) = store.add(archive(tmp_path / "image.tar", [b"other code"]))
    assert store.references() == [changed]
    assert store.get("localhost/thing:dev") == changed


def test_unused_layers_are_removed(tmp_path: Path) -> None:
    (former,) = store.add(archive(tmp_path / "image.tar", [b"system", b"code"]))
    (changed,) = store.add(archive(tmp_path / "image.tar", [b"system", b"other code"]))
    store.prune()
    with store.archive([changed], []) as path:
        assert digest(b"system") in blobs(path)
    with pytest.raises(FileNotFoundError), store.archive([former], []):
        pass


def test_a_layer_with_a_wrong_digest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(store.NotAnImage, match=r"layer 0\.tar has the hash sha256:.*configuration says sha256:"):
        store.add(archive(tmp_path / "image.tar", [b"forged"], digests=[digest(b"code")]))
    assert store.references() == []


def test_an_image_without_a_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(store.NotAnImage, match="no names"):
        store.add(archive(tmp_path / "image.tar", [b"code"], name=None))


def test_a_file_of_another_format_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(store.NotAnImage, match="text"):
        store.add(tmp_path / "text")
    with tarfile.open(tmp_path / "other.tar", "w") as tar:
        tar.add(tmp_path / "text", "text")
    with pytest.raises(store.NotAnImage, match=r"manifest\.json"):
        store.add(tmp_path / "other.tar")
