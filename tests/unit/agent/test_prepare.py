"""The profiles of an instance are written before its processes read them."""

from __future__ import annotations

import subprocess
import sys

from tests.unit.agent.conftest import PACKAGE, Pod, eventually
from understudy.api import names
from understudy.ros.rmw import MIDDLEWARE

PROFILES = f"<name>understudy-${{{names.POD_VARIABLE}}}</name>"


def test_the_init_container_inserts_the_pod_name_and_never_overwrites(tmp_path):
    (tmp_path / "in.xml").write_text(PROFILES)
    environment = {
        "PYTHONPATH": str(PACKAGE),
        "UNDERSTUDY_PROFILES": str(tmp_path / "in.xml"),
        "UNDERSTUDY_DIR": str(tmp_path),
    }
    for pod in ("robot-1", "robot-2"):
        command = [sys.executable, "-m", "understudy.main", "prepare"]
        subprocess.run(command, env={**environment, names.POD_VARIABLE: pod}, check=True, timeout=60)
        assert (tmp_path / names.PROFILES_KEY).read_text() == "<name>understudy-robot-1</name>"
    assert (tmp_path / names.PROFILES_KEY).stat().st_mode & 0o777 == 0o644


def test_missing_profiles_are_reported(tmp_path):
    environment = {"PYTHONPATH": str(PACKAGE), "UNDERSTUDY_PROFILES": str(tmp_path / "no.xml")}
    command = [sys.executable, "-m", "understudy.main", "prepare"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "no.xml" in done.stderr


async def test_a_held_pod_receives_its_profiles_with_the_claim(pod: Pod, links):
    pod.start_agent()
    pod.start_container(
        ["/bin/sh", "-c", f'echo "file ${MIDDLEWARE.settings_variable}"; cat "${MIDDLEWARE.settings_variable}"']
    )
    links.append(link := pod.link())
    await link.wait_for(lambda s: s.ready, 60)
    await link.start({}, {}, profiles=PROFILES)
    await eventually(lambda: "</name>" in pod.output(), 60)
    assert f"file {pod.volume}/profiles.xml\n<name>understudy-pool-abcde</name>" in pod.output()
