"""A container store with the images of new nodes. A node gets its own store by hard links, which takes no time and no
space.

That is safe because a container store never changes a blob or a lower layer; only its databases are copied.
"""

import hashlib
import io
import json
import os
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from testcluster import atomic, locks
from testcluster.images import containerd
from testcluster.images import store as images
from testcluster.local import cgroups, processes
from testcluster.local.programs import Programs
from testcluster.paths import cache, mark
from testcluster.progress import Progress, wait_until
from testcluster.shell import run, succeeds

PAUSE_IMAGE = "localhost/understudy-pause:1"
_LISTING = "understudy-images.json"
COREDNS_IMAGE = "localhost/understudy-coredns:1"


def _single_program_image(archive: Path, name: str, program: Path) -> None:
    """Write an image that contains one static program, as an archive in the format of `docker save`."""
    layer = io.BytesIO()
    with tarfile.open(fileobj=layer, mode="w") as tar:
        entry = tarfile.TarInfo(program.name)
        entry.mode = 0o755
        entry.size = program.stat().st_size
        with program.open("rb") as executable:
            tar.addfile(entry, executable)
    data = layer.getvalue()
    machine = {"x86_64": "amd64", "aarch64": "arm64"}.get(os.uname().machine, os.uname().machine)
    config = json.dumps(
        {
            "architecture": machine,
            "os": "linux",
            "config": {"Entrypoint": [f"/{program.name}"]},
            "rootfs": {"type": "layers", "diff_ids": [f"sha256:{hashlib.sha256(data).hexdigest()}"]},
        }
    ).encode()
    manifest = json.dumps([{"Config": "config.json", "RepoTags": [name], "Layers": ["layer.tar"]}]).encode()
    with tarfile.open(archive, "w") as tar:
        for member, content in (("config.json", config), ("layer.tar", data), ("manifest.json", manifest)):
            entry = tarfile.TarInfo(member)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))


def _listed(store: Path) -> dict[str, str] | None:
    """Return the images of a store by name and content hash; None if the store is missing or unfinished."""
    try:
        listed: dict[str, str] = json.loads((store / _LISTING).read_text())
    except FileNotFoundError:
        return None
    return listed


def _store(programs: Programs) -> Path:
    return cache() / "golden" / programs.hyperkube.parent.name


@contextmanager
def _containerd(root: Path) -> Iterator[list[str | Path]]:
    """Run a containerd on a store, and yield the command line of its client."""
    # The name has a dot, because no cluster's group can have such a name.
    group = f"understudy.golden-{mark()}"
    cgroups.kill(group)
    cgroups.create(group)
    with tempfile.TemporaryDirectory(prefix="understudy-", ignore_cleanup_errors=True) as name:
        work = Path(name)
        config = work / "containerd.toml"
        config.write_text(
            f'version = 2\nroot = "{root}"\nstate = "{work}/state"\n'
            f'disabled_plugins = ["io.containerd.grpc.v1.cri"]\n[grpc]\n  address = "{work}/socket"\n'
        )
        try:
            server = processes.start(group, ["containerd", "--config", config], cache() / "log" / "golden.log")
            client: list[str | Path] = ["ctr", "-a", work / "socket"]
            what = "containerd for the images of new nodes"
            wait_until(lambda: succeeds(*client, "version"), 20, f"{what} answers")
            yield client
            # The databases are complete on disk only after containerd has closed them.
            run("kill", "-TERM", str(server))
            wait_until(lambda: not cgroups.pids(group), 20, f"{what} ends")
        finally:
            cgroups.kill(group)
            cgroups.remove(group)


def ensure(programs: Programs, progress: Progress) -> None:
    """Make the store, or add the images of the machine's image store that it lacks.

    A changed copy replaces the store, so that neither an interruption nor a node that is cloned meanwhile gets an
    incomplete store.
    """
    with locks.held("golden", progress), locks.held("images", progress):
        wanted = images.references()
        listing = {reference.name: reference.digest for reference in wanted}
        if _listed(_store(programs)) != listing:
            _renew(programs, wanted, listing, progress)


def _renew(
    programs: Programs, wanted: Sequence[images.Reference], listing: Mapping[str, str], progress: Progress
) -> None:
    store = _store(programs)
    following, former = (store.with_name(f"{store.name}.{name}") for name in ("following", "former"))
    with progress.step("preparing the images that new nodes begin with"):
        shutil.rmtree(following, ignore_errors=True)
        shutil.rmtree(former, ignore_errors=True)
        with atomic.folder(following) as root:
            if store.exists():
                _copy(store, root)
            with _containerd(root) as client:
                if not store.exists():
                    _import_own(client, programs)
                containerd.load(client, wanted)
            (root / _LISTING).write_text(json.dumps(listing))
        if store.exists():
            store.rename(former)
        following.rename(store)
        shutil.rmtree(former, ignore_errors=True)


def _import_own(client: list[str | Path], programs: Programs) -> None:
    """Bring the cluster's own images to a container runtime."""
    with tempfile.TemporaryDirectory(prefix="understudy-") as folder:
        for image, program in ((PAUSE_IMAGE, programs.pause), (COREDNS_IMAGE, programs.coredns)):
            archive = Path(folder) / "image.tar"
            _single_program_image(archive, image, program)
            run(*client, "-n", "k8s.io", "images", "import", archive)


def _copy(store: Path, destination: Path) -> None:
    """Fill an empty folder with a store's content. Files that are never written in place become hard links."""
    run("cp", "-a", "--link", f"{store}/.", destination)
    for shared in (*destination.rglob("*.db"), destination / _LISTING):
        copy = shared.with_name(f"{shared.name}.copy")
        shutil.copy2(shared, copy)
        copy.rename(shared)


def clone(programs: Programs, destination: Path) -> None:
    """Give a node its store, unless it has one."""
    if destination.exists():
        return
    with atomic.folder(destination) as partial, locks.held("golden"):
        _copy(_store(programs), partial)
