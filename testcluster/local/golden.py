"""A container store with the images every node needs, made once; a node gets its own by hard links, which takes no time and no space.

That is sound because a container store never writes to a blob or to a lower layer again; only its databases are copied.
"""

import hashlib
import io
import json
import os
import shutil
import tarfile
from pathlib import Path

from testcluster.local import cgroups, processes
from testcluster.local.programs import Programs
from testcluster.paths import cache
from testcluster.progress import Progress, wait_until
from testcluster.shell import run, succeeds

PAUSE_IMAGE = "localhost/understudy-pause:1"
COREDNS_IMAGE = "localhost/understudy-coredns:1"
_BUILDERS = "understudy-golden"


def _single_program_image(archive: Path, name: str, program: Path) -> None:
    """Writes an image that holds one static program, as an archive in the format of `docker save`."""
    layer = io.BytesIO()
    with tarfile.open(fileobj=layer, mode="w") as tar:
        entry = tarfile.TarInfo(program.name)
        entry.mode = 0o755
        entry.size = program.stat().st_size
        with program.open("rb") as content:
            tar.addfile(entry, content)
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


def _store(programs: Programs) -> Path:
    return cache() / "golden" / programs.hyperkube.parent.name


def ensure(programs: Programs, progress: Progress) -> None:
    """Makes the store unless it is there."""
    store = _store(programs)
    if store.exists():
        return
    with progress.step("preparing the images of the cluster itself"):
        work = store.with_name(f"{store.name}.partial")
        group = f"{_BUILDERS}/{store.name}"
        cgroups.kill(group)
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        cgroups.create(group)
        address = work / "socket"
        config = work / "containerd.toml"
        config.write_text(
            f'version = 2\nroot = "{work}/root"\nstate = "{work}/state"\n'
            f'disabled_plugins = ["io.containerd.grpc.v1.cri"]\n[grpc]\n  address = "{address}"\n'
        )
        try:
            processes.start(group, ["containerd", "--config", config], cache() / "log" / "golden.log")
            wait_until(lambda: succeeds("ctr", "-a", address, "version"), 20, "containerd for the cluster's own images answers")
            for image, program in ((PAUSE_IMAGE, programs.pause), (COREDNS_IMAGE, programs.coredns)):
                archive = work / "image.tar"
                _single_program_image(archive, image, program)
                run("ctr", "-a", address, "-n", "k8s.io", "images", "import", archive)
        finally:
            cgroups.kill(group)
            cgroups.remove(group)
            cgroups.remove(_BUILDERS)
        (work / "root").rename(store)
        shutil.rmtree(work)


def clone(programs: Programs, destination: Path) -> None:
    """Gives a node its store, unless it has one."""
    if destination.exists():
        return
    partial = destination.with_name(f"{destination.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    run("cp", "-a", "--link", _store(programs), partial)
    for database in partial.rglob("*.db"):
        copy = database.with_name(f"{database.name}.copy")
        shutil.copy2(database, copy)
        copy.rename(database)
    partial.rename(destination)
