"""A stand-in for kubectl: it answers from a file of objects, patches them, and prints a line for each change of the
file if it watches."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SCRIPT = """#!{python} -IS
import json, os, sys, time
path, asked = {settings!r}, {asked!r}
arguments = sys.argv[1:]
with open(asked, "a") as log:
    log.write(" ".join(arguments) + "\\n")
plural = lambda item: (item["kind"].lower() + "s").replace("ys", "ies")
rest = arguments[arguments.index("get") + 1 :] if "get" in arguments else [""]
kinds = {{kind.partition(".")[0] for kind in rest[0].split(",")}}
settings = json.load(open(path))
forbidden = kinds & set(settings["forbidden"])
if "--watch-only" in arguments:
    if forbidden or not settings["watch"]:
        sys.exit("Error from server (Forbidden): you may not watch")
    before, changed_at = settings, os.stat(path).st_mtime_ns
    while True:
        time.sleep(0.05)
        if os.stat(path).st_mtime_ns == changed_at:
            continue
        changed_at = os.stat(path).st_mtime_ns
        try:
            settings = json.load(open(path))
        except ValueError:
            continue  # it is being written
        of_it = lambda settings: (settings["error"], [item for item in settings["items"] if plural(item) in kinds])
        if of_it(settings) != of_it(before):
            print("changed", flush=True)
        before = settings
if settings["error"]:
    sys.exit(settings["error"])
if forbidden:
    sys.exit(f"Error from server (Forbidden): {{rest[0]}} is forbidden: you may not list it")
if "patch" in arguments:
    kind, name = arguments[arguments.index("patch") + 1 :][:2]
    patch = json.loads(arguments[arguments.index("-p") + 1])
    def merged(old, new):
        if not isinstance(old, dict) or not isinstance(new, dict):
            return new
        both = {{**old, **{{key: merged(old.get(key, {{}}), value) for key, value in new.items()}}}}
        return {{key: value for key, value in both.items() if value is not None}}
    for number, item in enumerate(settings["items"]):
        if item["metadata"]["name"] == name and plural(item) == kind.partition(".")[0]:
            settings["items"][number] = merged(item, patch)
            if "--dry-run=server" not in arguments:
                json.dump(settings, open(path, "w"))
            print(json.dumps(settings["items"][number]))
            sys.exit(0)
    sys.exit(f'Error from server (NotFound): {{kind}} "{{name}}" not found')
if "delete" in arguments or "exec" in arguments:
    sys.exit(0)
if "config" in arguments:
    print(json.dumps({{"contexts": [{{"name": "lab", "context": {{"namespace": "fleet"}}}}]}}))
    sys.exit(0)
if "annotate" in arguments:
    kind, name = arguments[arguments.index("annotate") + 1 :][:2]
    note, _, value = next(a for a in arguments if "=" in a and not a.startswith("-")).partition("=")
    for item in settings["items"]:
        if item["metadata"]["name"] == name:
            item["metadata"].setdefault("annotations", {{}})[note] = value
    settings["asked"] = value
    if "--dry-run=server" not in arguments:
        json.dump(settings, open(path, "w"))
    sys.exit(0)
if settings["then"] and settings["asked"]:
    fields = json.loads(json.dumps(settings["then"].pop(0)).replace("ASKED", settings["asked"]))
    settings["items"][0]["status"] |= fields
    json.dump(settings, open(path, "w"))
names = []
for argument in rest[1:]:
    if argument.startswith("-"):
        break
    names.append(argument)
found = [item for item in settings["items"] if plural(item) in kinds]
if "-l" in rest and kinds == {{"robotworkloads"}}:
    key, _, value = rest[rest.index("-l") + 1].partition("=")
    found = [item for item in found if item["metadata"].get("labels", {{}}).get(key) == value]
    print(json.dumps({{"kind": "List", "items": found}}))
    sys.exit(0)
named = [item for name in names for item in found if item["metadata"]["name"] == name]
if names and len(named) < len(names):
    if "--ignore-not-found" in arguments:
        if named:
            print(json.dumps({{"kind": "List", "items": named}}))
        sys.exit(0)
    sys.exit(f'Error from server (NotFound): {{rest[0]}} "{{names[-1]}}" not found')
print(json.dumps(named[0] if len(named) == 1 else {{"kind": "List", "items": named or found}}))
"""


class FakeKubectl:
    """Controls the answers of the stand-in, and records its calls."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._settings, self._asked = folder / "settings.json", folder / "asked"
        self.tell([])
        program = folder / "kubectl"
        program.write_text(SCRIPT.format(python=sys.executable, settings=str(self._settings), asked=str(self._asked)))
        program.chmod(0o755)

    def begin_with(self, code: str) -> None:
        """Run this code at the beginning of each call."""
        program = self.folder / "kubectl"
        text, begin = program.read_text(), "arguments = sys.argv[1:]"
        assert begin in text
        program.write_text(text.replace(begin, f"{code}\n{begin}", 1))

    def tell(
        self,
        items: Sequence[dict[str, Any]],
        *,
        error: str = "",
        watch: bool = True,
        forbidden: Sequence[str] = (),
        then: Sequence[dict[str, Any]] = (),
    ) -> None:
        """Answer with these objects from now on, or with an error; ``watch`` allows watches. Resources that are
        ``forbidden``, such as ``networkpolicies``, can be neither listed nor watched.

        ``then`` has fields of the first object's status, which follow each other after an annotation was written. ASKED
        in them stands for its value.
        """
        fresh = self.folder / "fresh.json"
        answers = {"items": list(items), "error": error, "watch": watch, "forbidden": list(forbidden)}
        answers |= {"then": list(then), "asked": ""}
        fresh.write_text(json.dumps(answers))
        fresh.replace(self._settings)

    def item(self, name: str) -> dict[str, Any]:
        """Return an object with the patches that were applied."""
        found: dict[str, Any] = next(
            item for item in json.loads(self._settings.read_text())["items"] if item["metadata"]["name"] == name
        )
        return found

    @property
    def asked(self) -> list[str]:
        """The command lines so far."""
        return self._asked.read_text().splitlines() if self._asked.exists() else []
