"""A stand-in for a monitor's status port, and a kubectl that forwards a port to it."""

from __future__ import annotations

from typing import Any

READY = {"conditions": [{"type": "Ready", "status": "True"}]}
KUBECTL = """#!{python} -IS
import json, sys, time
settings = json.load(open({settings!r}))
with open({asked!r}, "a") as log:
    log.write(" ".join(sys.argv[1:]) + "\\n")
if "port-forward" in sys.argv:
    if settings["port"] is None:
        sys.exit("error: unable to forward port because pod is not running")
    print(f"Forwarding from 127.0.0.1:{{settings['port']}} -> 9108", flush=True)
    time.sleep(60)
elif "robotworkload" in sys.argv:
    if settings["workload"] is None:
        sys.exit('Error from server (NotFound): robotworkloads.understudy.dev "robot-2" not found')
    print(json.dumps(settings["workload"]))
else:
    print(json.dumps({{"items": settings["pods"]}}))
"""


def leaf(name: str, state: str = "Healthy", *, received: int | None = 10, age: float | None = 0.05, **more: Any) -> Any:
    found = {"name": name, "kind": "topic", "state": state, "reason": "", "topic": f"/{name}", **more}
    return found | ({"received": received, "age": age} if received is not None else {})


def state(time: float = 100.0, health: str = "Healthy", **more: Any) -> dict[str, Any]:
    driving = {
        "name": "driving", "kind": "while", "task": "/navigate_to_pose", "state": "Idle", "reason": "",
        "children": [leaf("cmd_vel", "Idle", received=0, age=None)],
    }  # fmt: skip
    found: dict[str, Any] = {
        "workload": "robot-1-drive", "namespace": "fleet", "policy": "navigation", "time": time, "health": health,
        "active": "robot-1-drive-abc", "epoch": 3, "strategy": "Executing", "recoveries": 2, "notes": [],
        "conditions": [{"type": "Monitored", "status": "True", "reason": "Watching", "message": "Watching /scan."}],
        "tree": {
            "name": "parallel", "kind": "parallel", "state": "Healthy", "reason": "",
            "children": [leaf("scan"), driving, leaf("node", received=None, kind="publisher")],
        },
    }  # fmt: skip
    return found | more
