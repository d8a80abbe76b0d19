"""Building Go programs: keyed by their sources, with a compiler that is new enough."""

from __future__ import annotations

from pathlib import Path

import pytest

from testcluster import golang
from testcluster.progress import Progress


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "module"
    folder.mkdir()
    (folder / "go.mod").write_text("module example\n\ngo 1.24.0\n")
    (folder / "main.go").write_text("package main\n\nfunc main() {}\n")
    (folder / "main_test.go").write_text("package main\n")
    return folder


def compiler(path: Path, version: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho go version go{version} linux/amd64\n")
    path.chmod(0o755)
    return path


def test_sources_and_flags_decide_a_build_and_tests_do_not(module: Path) -> None:
    before = golang.fingerprint(module, "-flag")
    (module / "main_test.go").write_text("package main // changed\n")
    assert golang.fingerprint(module, "-flag") == before
    assert golang.fingerprint(module, "-other") != before
    (module / "main.go").write_text("package main\n\nfunc main() { println() }\n")
    assert golang.fingerprint(module, "-flag") != before


def test_the_version_of_a_compiler_is_read(tmp_path: Path) -> None:
    assert golang.version(str(compiler(tmp_path / "go", "1.26.3"))) == (1, 26)
    assert golang.version(str(tmp_path / "missing")) is None


def test_an_old_compiler_is_ignored(tmp_path: Path) -> None:
    old, new = compiler(tmp_path / "old" / "go", "1.19.8"), compiler(tmp_path / "new" / "go", "1.24.0")
    assert golang.usable([old, None, new]) == str(new)
    assert golang.usable([old]) is None


def test_an_existing_build_is_used_without_a_compiler(module: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(progress: Progress) -> str:
        raise AssertionError("no compiler is needed")

    monkeypatch.setattr(golang, "compiler", none)
    built = golang.cache() / "bin" / f"thing-{golang.fingerprint(module, '.')}"
    built.mkdir(parents=True)
    assert golang.build("thing", module, ["."], [], Progress(), "a second") == built


def test_a_compile_error_is_reported_with_the_compiler_output(
    module: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    go = tmp_path / "go"
    go.write_text("#!/bin/sh\necho main.go:3: undefined: nothing\nexit 1\n")
    go.chmod(0o755)
    monkeypatch.setattr(golang, "compiler", lambda progress: str(go))
    with pytest.raises(golang.CommandFailed, match="undefined: nothing"):
        golang.build("thing", module, ["."], [], Progress(), "a second")
    assert not list((golang.cache() / "bin").iterdir())
