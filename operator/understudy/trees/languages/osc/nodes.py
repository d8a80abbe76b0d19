"""Reads the nodes of a scenario: compositions, actions, and their modifiers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from understudy.trees.languages.osc import values
from understudy.trees.languages.osc.document import Document
from understudy.trees.languages.osc.grammar import Part
from understudy.trees.languages.osc.library import COMPOSITIONS, RATES, Argument, Behavior
from understudy.trees.languages.text.source_map import MOST_PROBLEMS, LocatedProblem, Origin, ParsedNode
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import DEEPEST, MOST

_Arguments = dict[str, tuple[str, Part]]
"""By argument, its value in the short form, and its position in the text."""

_Read = Callable[[Part, Part | None, int], ParsedNode | None]


class Nodes:
    """Converts parts to parsed nodes, and collects problems; a part that cannot be read becomes None."""

    def __init__(self, document: Document, path: str) -> None:
        self.problems: list[LocatedProblem] = []
        self._constants, self._path = document.constants, path
        self._dialect = document.dialect
        self._count = 0

    def tree(self, main: Part) -> ParsedNode | None:
        """Read the behaviour of a scenario with everything in it."""
        return self._member(main, 1)

    def _member(self, member: Part, depth: int) -> ParsedNode | None:
        """Read a node with an optional name in front of it."""
        name = member.first("labelName")
        for found in member.parts:
            if found.rule == "composition":
                return self._modified(found, name, depth, self._composition)
            if found.rule == "behaviorInvocation":
                return self._modified(found, name, depth, self._action)
        # Words that wait, send events or call functions have been refused before.
        self._note(
            member, "do", f"is not a node; give serial:, parallel:, one_of: or a leaf such as {self._dialect.example}"
        )
        return None

    def _counted(self, part: Part, label: str, depth: int) -> bool:
        """Return whether one more node is allowed here."""
        self._count += 1
        if self._count == MOST + 1:
            self._note(part, label, f"the tree has more than {MOST} nodes")
        elif depth == DEEPEST + 1:
            self._note(part, label, f"the tree is more than {DEEPEST} levels deep")
        return self._count <= MOST and depth <= DEEPEST and len(self.problems) <= MOST_PROBLEMS

    # -- nodes ------------------------------------------------------------------------------------------------------

    def _composition(self, part: Part, name: Part | None, depth: int) -> ParsedNode | None:
        operator = part.text_of("compositionOperator")
        origin = Origin(f"{operator}:", part.line, part.column)
        if not self._counted(part, origin.label, depth):
            return None
        if (arguments := part.first("argumentList")) is not None:
            self._note(arguments, origin.label, "takes no arguments; remove the brackets")
        built = [self._member(child, depth + 1) for child in part.all("doMember")]
        children = [child for child in built if child is not None]
        if not children:
            return None
        named = self._named(name)
        return ParsedNode(origin, COMPOSITIONS[operator], _name(named), children=children, places=_places(named))

    def _action(self, part: Part, name: Part | None, depth: int) -> ParsedNode | None:
        called = part.text_of("behaviorName")
        label = f"{called:.60}()"
        dialect = self._dialect
        if not self._counted(part, label, depth):
            return None
        if called in dialect.actions:
            action = dialect.actions[called]
            arguments = self._arguments(part, label, action)
            if arguments is None or (
                not RATES.keys().isdisjoint(action.arguments) and not self._rated(part, label, arguments)
            ):
                return None
            return _written(Origin(label, part.line, part.column), action, arguments, self._named(name))
        if called in dialect.modifiers:
            self._note(part, label, f"is a modifier; write it in the with: of the node that it is for: with: {label}")
        else:
            self._refuse(part, label, called, "behaviour", (*dialect.actions, *dialect.modifiers))
        return None

    def _named(self, name: Part | None) -> Part | None:
        """Return the name in front of a node, if names have a meaning in this kind of tree."""
        return name if self._dialect.subject.named else None

    def _modified(self, part: Part, name: Part | None, depth: int, read: _Read) -> ParsedNode | None:
        """Wrap a node in its modifiers, the first of which is the outermost."""
        block = part.first("behaviorWithDeclaration")
        modifiers = [found for member in block.all("behaviorWithMember") for found in member.parts] if block else []
        around = [self._modifier(found, depth + index) for index, found in enumerate(modifiers)]
        node = read(part, name, depth + len(modifiers))
        for modifier in reversed(around):
            if modifier is None or node is None:
                return None
            behavior, origin, arguments = modifier
            node = _written(origin, behavior, arguments, None, [node])
        return node

    def _modifier(self, part: Part, depth: int) -> tuple[Behavior, Origin, _Arguments] | None:
        called = part.text_of("modifierName")
        label = f"{called:.60}()"
        dialect = self._dialect
        if not self._counted(part, label, depth):
            return None
        if called in dialect.modifiers:
            modifier = dialect.modifiers[called]
            arguments = self._arguments(part, label, modifier)
            return (modifier, Origin(label, part.line, part.column), arguments) if arguments is not None else None
        if called in dialect.actions:
            self._note(part, label, "is a node of its own; put it beside the other, in a parallel:")
        else:
            self._refuse(part, label, called, "modifier", dialect.modifiers)
        return None

    def _refuse(self, part: Part, label: str, called: str, what: str, known: Iterable[str]) -> None:
        """Report a behaviour or modifier that the dialect does not have, or refuses."""
        refused = self._dialect.refused
        if called in refused:
            self._note(part, label, f"is not for {self._dialect.subject.many}: {refused[called]}")
        else:
            self._note(part, label, f"unknown {what}{did_you_mean(called, known)}")

    # -- arguments --------------------------------------------------------------------------------------------------

    def _arguments(self, part: Part, label: str, behavior: Behavior) -> _Arguments | None:
        """Return the values of the arguments by name; None if one of them cannot be determined."""
        known = list(behavior.arguments.values())
        listed = part.first("argumentList")
        arguments: dict[str, tuple[str, Part]] = {}
        before = len(self.problems)
        whole = True
        for index, found in enumerate(listed.all("positionalArgument", "namedArgument") if listed is not None else ()):
            value = found.parts[-1]
            if found.rule == "namedArgument":
                name = found.text_of("argumentName")
                if name not in behavior.arguments:
                    hint = did_you_mean(name, behavior.arguments) if known else "; it takes none"
                    self._note(found, f"{label} {name:.60}", f"unknown argument{hint}")
                    continue
            elif index >= len(known):
                least = f"it takes {len(known)}" if known else "it takes none"
                self._note(found, label, f"found argument number {index + 1}; {least}")
                continue
            else:
                name = known[index].name
            if name in arguments:
                self._note(found, f"{label} {name}", "is given twice; remove one of them")
                continue
            text = self._value(value, label, behavior.arguments[name])
            whole = whole and text is not None
            arguments[name] = (text or "", value)
        return arguments if whole and len(self.problems) == before else None

    def _value(self, value: Part, label: str, argument: Argument) -> str | None:
        try:
            return values.read(value, argument.type, self._constants)
        except ValueError as error:
            self._note(value, f"{label} {argument.name}", str(error))
            return None

    def _rated(self, part: Part, label: str, arguments: _Arguments) -> bool:
        """Combine the bounds of a rate; return whether the short form supports the combination."""
        bounds = [name for name in arguments if name in RATES]
        if len(bounds) > 1 and set(bounds) != {"rate_min", "rate_max"}:
            self._note(
                arguments[bounds[1]][1],
                label,
                f"found {' and '.join(bounds)}; give one of them, or rate_min and rate_max",
            )
            return False
        if not bounds and "gap" not in arguments:
            self._note(
                part, label, "neither gap nor a rate is given; give gap, such as 500ms, or rate_above, such as 8Hz"
            )
            return False
        if not bounds and "window" in arguments:
            message = "a window is only for a rate; give rate_above or another bound, or remove window"
            self._note(arguments["window"][1], f"{label} window", message)
            return False
        band = " to ".join(arguments[name][0] for name in ("rate_min", "rate_max") if name in arguments)
        sign = f"{RATES[bounds[0]]} " if len(bounds) == 1 else ""
        for name in bounds:
            arguments[name] = (sign + (band or arguments[name][0]), arguments[name][1])
        return True

    def _note(self, part: Part, label: str, message: str) -> None:
        self.problems.append(Origin(label, part.line, part.column).problem(self._path, message))


def _written(
    origin: Origin,
    behavior: Behavior,
    arguments: _Arguments,
    name: Part | None,
    children: list[ParsedNode] | None = None,
) -> ParsedNode:
    """Build a node of the library with the given values."""
    spelled = {name: value for name, (value, _) in arguments.items()}
    places = {name: Origin(origin.label, part.line, part.column) for name, (_, part) in arguments.items()}
    # If several arguments form one value, problems with it are reported at the last given one.
    named = sorted(behavior.arguments, key=lambda argument: argument in arguments)
    ports = {argument: behavior.arguments[argument].where for argument in named}
    reads = {name: one.reads for name, one in behavior.arguments.items() if one.reads is not None}
    known = {**places, **_places(name)}
    return ParsedNode(origin, behavior.key, _name(name), ports, spelled, children or [], known, reads)


def _name(name: Part | None) -> str | None:
    """Return the name in front of a node, without the bars that enclose a name with characters other than letters."""
    return name.text.strip("|") if name is not None else None


def _places(name: Part | None) -> Mapping[str, Origin]:
    return {"name": Origin(f"{name.text:.60}:", name.line, name.column)} if name is not None else {}
