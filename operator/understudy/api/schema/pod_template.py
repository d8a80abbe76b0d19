"""The schema of pod templates embedded in our kinds.

Kubernetes' own pod schema would be thousands of lines in each kind and of another version than the cluster's. So what isn't
named here is preserved as it is and judged by the API server when a pod is made from it; what is named here are the
parts that Understudy relies on, so that a template which could never be protected is refused at once.
"""

from __future__ import annotations

from typing import Any

from understudy.api.base import GROUP, rules

_PRESERVED = {"x-kubernetes-preserve-unknown-fields": True}
_MOST_CONTAINERS = 32
_MOST_LABELS = 64


def pod_template(*container_rules: tuple[str, str, str]) -> dict[str, Any]:
    """``json_schema_extra`` of a pod template, with CEL rules that hold for each of its containers."""
    return {
        "properties": {
            "metadata": {
                "type": "object",
                "description": "Labels and annotations of the pods. Names are given by Understudy.",
                "properties": {
                    "labels": _texts("Labels of the pods.")
                    | rules(
                        (
                            f"self.all(key, !key.startsWith('{GROUP}/'))",
                            f"labels that begin with {GROUP}/ decide who drives the robot and are set by Understudy: take another name",
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
                                "name": {"type": "string", "minLength": 1, "maxLength": 63, "description": "Its name."},
                                "image": {"type": "string", "minLength": 1, "description": "Its image."},
                                "command": {
                                    "type": "array",
                                    "items": {"type": "string"},
                                    "description": "What it runs; the image's own entry point where there is none.",
                                },
                            },
                        }
                        | _PRESERVED
                        | (rules(*container_rules) if container_rules else {}),
                    },
                    "hostNetwork": {
                        "type": "boolean",
                        "description": "Must not be true: no NetworkPolicy holds for a pod in its node's network.",
                    },
                    "restartPolicy": {
                        "type": "string",
                        "enum": ["Always"],
                        "description": "Always, as in a Deployment.",
                    },
                },
            }
            | _PRESERVED
            | rules(
                (
                    "!has(self.hostNetwork) || !self.hostNetwork",
                    "hostNetwork can't be gated: no NetworkPolicy holds for a pod in its node's network",
                    ".hostNetwork",
                )
            ),
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
