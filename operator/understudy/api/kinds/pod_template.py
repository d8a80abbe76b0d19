"""The schema of pod templates that are embedded in our kinds.

A copy of Kubernetes' own pod schema would add thousands of lines to each kind, and could differ from the cluster's version. So
only the parts that Understudy relies on are described here, and a template that could never be protected is refused at once. Other
fields are preserved, and the API server checks them when it creates a pod.
"""

from __future__ import annotations

from typing import Any

from understudy.api.base import GROUP, rules

_PRESERVED = {"x-kubernetes-preserve-unknown-fields": True}
_MOST_CONTAINERS = 32
_MOST_LABELS = 64


def pod_template(*container_rules: tuple[str, str, str], any_network: bool = False) -> dict[str, Any]:
    """``json_schema_extra`` of a pod template, with CEL rules for its containers. ``any_network`` allows the network of the node."""
    pod_network = (
        "!has(self.hostNetwork) || !self.hostNetwork",
        "hostNetwork is not allowed, because NetworkPolicies, and so the gate, do not apply to a pod in its node's network",
        ".hostNetwork",
    )
    return {
        "properties": {
            "metadata": {
                "type": "object",
                "description": "Labels and annotations of the pods. Understudy sets their names.",
                "properties": {
                    "labels": _texts("Labels of the pods.")
                    | rules(
                        (
                            f"self.all(key, !key.startsWith('{GROUP}/'))",
                            f"labels that begin with {GROUP}/ decide which pod controls the robot, "
                            "so only Understudy sets them: use another prefix",
                        )
                    ),
                    "annotations": _texts("Annotations of the pods."),
                },
            },
            "spec": {
                "type": "object",
                "description": "Pod spec, as in a Deployment's template (kubectl explain pod.spec).",
                "required": ["containers"],
                "properties": {
                    "containers": {
                        "type": "array",
                        "description": "The application's containers.",
                        "minItems": 1,
                        "maxItems": _MOST_CONTAINERS,
                        "items": {
                            "type": "object",
                            "description": "A container, as in a pod (kubectl explain pod.spec.containers).",
                            "required": ["name", "image"],
                            "properties": {
                                "name": {
                                    "type": "string",
                                    "minLength": 1,
                                    "maxLength": 63,
                                    "description": "Name of the container.",
                                },
                                "image": {"type": "string", "minLength": 1, "description": "Image of the container."},
                                "command": {
                                    "type": "array",
                                    "items": {"type": "string"},
                                    "description": "Command of the container. "
                                    + ("Required." if container_rules else "Absent: the entry point of the image."),
                                },
                            },
                        }
                        | _PRESERVED
                        | (rules(*container_rules) if container_rules else {}),
                    },
                    "hostNetwork": {
                        "type": "boolean",
                        "description": "Network of the node. Only with gate kind Mux, because NetworkPolicies do not apply there."
                        if any_network
                        else "Must not be true: NetworkPolicies do not apply to a pod in its node's network.",
                    },
                    "restartPolicy": {
                        "type": "string",
                        "enum": ["Always"],
                        "description": "Must be Always, which is also the default.",
                    },
                },
            }
            | _PRESERVED
            | ({} if any_network else rules(pod_network)),
        },
        "required": ["spec"],
    }


def _texts(description: str) -> dict[str, Any]:
    return {
        "type": "object",
        "description": description,
        "maxProperties": _MOST_LABELS,
        "additionalProperties": {"type": "string"},
    }
