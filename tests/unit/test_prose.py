"""`scripts/prose`: the English that Vale reads, with the lines it stands on."""

from __future__ import annotations

from scripts.prose_check import Text, python_texts, yaml_texts

SOURCE = '''"""A module."""

# Why it is so,
# in two lines.
LIMIT = 3
"""Most of them."""


def f(name: str) -> str:
    """Return a text.

    More of it.
    """
    key = "no-sentence"
    return f"the pod {name} is not ready" "and it waits"
'''


def test_comments_and_docstrings_keep_their_line_numbers() -> None:
    found = [text.lines for text in python_texts(SOURCE) if text.kind == "comments"]
    assert ((3, "Why it is so,"), (4, "in two lines.")) in found
    assert ((1, "A module."),) in found
    assert ((6, "Most of them."),) in found
    assert any((12, "    More of it.") in lines for lines in found)


def test_sentences_in_code_are_messages_and_identifiers_are_not() -> None:
    found = [text.lines for text in python_texts(SOURCE) if text.kind == "messages"]
    assert found == [((15, "the pod X is not readyand it waits"),)]


def test_descriptions_and_rules_of_a_crd_are_messages() -> None:
    source = "spec:\n  description: What is kept.\n  x:\n  - rule: self > 1\n    message: give more than one\n"
    assert list(yaml_texts(source)) == [
        Text("messages", ((2, "What is kept."),)),
        Text("messages", ((5, "give more than one"),)),
    ]
