"""JSON schemas of the kinds that are applied to clusters, in the folders in which kubeconform looks for them.

The schemas have the same sources as those that kubeconform would download: Kubernetes' own descriptions of its API,
from the module from which the local cluster is built, and CustomResourceDefinitions. All are closed: an API server
drops an unknown field, and here that is an error.

``python -m tests.support.schemas`` makes those of Kubernetes and of the Prometheus operator, once. It downloads their
modules if they are missing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from testcluster import atomic, golang, locks
from testcluster.local.programs import kubernetes_version
from testcluster.paths import cache
from testcluster.progress import Progress
from testcluster.shell import run

Schema = dict[str, Any]

LOCATION = "{{.Group}}/{{.ResourceKind}}_{{.ResourceAPIVersion}}.json"
"""The path of a kind's schema in such a folder, as a kubeconform template."""

PROMETHEUS_OPERATOR = "v0.85.0"
_SCRAPING = ("podmonitors", "prometheusrules")
"""The Prometheus operator's kinds of which the chart has objects."""

_LEFT_TO_KUBERNETES = {
    ("spec", "template", "spec"): "io.k8s.api.core.v1.PodSpec",
    ("spec", "monitor", "resources"): "io.k8s.api.core.v1.ResourceRequirements",
}
"""Fields that our own definitions leave open, since Kubernetes checks them when it creates the pods."""

_METADATA = "io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta"
_OPEN = "x-kubernetes-preserve-unknown-fields"
_ALL = "kubernetes.json"


def folder() -> Path:
    """Return the folder of the schemas of Kubernetes and of the Prometheus operator."""
    decided = f"{kubernetes_version()} {PROMETHEUS_OPERATOR} {Path(__file__).read_text()}"
    return cache() / "schemas" / hashlib.sha256(decided.encode()).hexdigest()[:12]


def ensure(progress: Progress) -> None:
    """Make that folder, unless it exists.

    Raises:
        CommandFailed, MissingPrograms: there is no Go compiler, or a module could not be downloaded.
    """
    with locks.held("schemas", progress):
        if folder().exists():
            return
        with atomic.folder(folder()) as made, progress.step("making schemas of Kubernetes' kinds (a minute, once)"):
            go = golang.ready_compiler(progress)
            kubernetes = _module(go, f"k8s.io/kubernetes@v{kubernetes_version()}")
            _of_kubernetes((kubernetes / "api" / "openapi-spec" / "v3").glob("*.json"), made)
            operator = _module(go, f"github.com/prometheus-operator/prometheus-operator@{PROMETHEUS_OPERATOR}")
            definitions = operator / "example" / "prometheus-operator-crd"
            of_definitions((definitions / f"monitoring.coreos.com_{one}.yaml" for one in _SCRAPING), made, Path(".."))


def of_definitions(definitions: Iterable[Path], out: Path, kubernetes: Path) -> None:
    """Write the schemas of the kinds that CustomResourceDefinitions define.

    Args:
        definitions: files with one definition each.
        out: the folder to write to.
        kubernetes: the folder with the schemas of Kubernetes, as seen from a schema that is written.
    """

    def reference(name: str) -> Schema:
        return {"$ref": f"{kubernetes / _ALL}#/components/schemas/{name}"}

    for path in definitions:
        spec = yaml.safe_load(path.read_text())["spec"]
        for version in spec["versions"]:
            schema = closed(version["schema"]["openAPIV3Schema"])
            # Every kind has these, even if its definition does not name them.
            own = {"apiVersion": {"type": "string"}, "kind": {"type": "string"}, "metadata": reference(_METADATA)}
            schema["properties"] |= own
            for fields, name in _LEFT_TO_KUBERNETES.items():
                if found := _field(schema, fields):
                    found["allOf"] = [*found.get("allOf", []), reference(name)]
            _write(out, spec["group"], spec["names"]["kind"], version["name"], schema)


def closed(schema: Schema) -> Schema:
    """Return a schema whose objects have no fields other than the named ones, without parts that do not affect
    validation."""
    found = {key: value for key, value in schema.items() if key not in ("description", "default", "example")}
    if "properties" in schema:
        found["properties"] = {name: closed(one) for name, one in schema["properties"].items()}
        if not schema.get(_OPEN):
            found.setdefault("additionalProperties", False)
    for inner in ("items", "additionalProperties"):
        if isinstance(schema.get(inner), dict):
            found[inner] = closed(schema[inner])
    return found


def _field(schema: Schema, fields: Iterable[str]) -> Schema | None:
    found: Schema | None = schema
    for field in fields:
        found = found and found.get("properties", {}).get(field)
    # A definition of somebody else states itself which fields it leaves open.
    return found if found and found.get(_OPEN) else None


def _of_kubernetes(documents: Iterable[Path], out: Path) -> None:
    """Write all definitions in one file, since they refer to each other, and for each kind a file that refers to its
    definition."""
    definitions: dict[str, Schema] = {}
    for document in documents:
        definitions |= json.loads(document.read_text()).get("components", {}).get("schemas", {})
    whole = {"components": {"schemas": {name: closed(one) for name, one in definitions.items()}}}
    (out / _ALL).write_text(json.dumps(whole))
    for name, definition in definitions.items():
        for kind in definition.get("x-kubernetes-group-version-kind", []):
            reference = {"$ref": f"../{_ALL}#/components/schemas/{name}"}
            # kubeconform takes the version for a missing group.
            _write(out, kind["group"] or kind["version"], kind["kind"], kind["version"], reference)


def _write(out: Path, group: str, kind: str, version: str, schema: Schema) -> None:
    path = out / group / f"{kind.lower()}_{version}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(schema))


def _module(go: str, module: str) -> Path:
    """Return the folder with a Go module's files."""
    download = json.loads(
        run(go, "mod", "download", "-json", module, cwd=cache(), env={"GOFLAGS": "", "GOWORK": "off"})
    )
    return Path(download["Dir"])


if __name__ == "__main__":
    ensure(Progress())
