"""The parts of a file: its imports, its scenario, and the scenario's parameters."""

from __future__ import annotations

from understudy.trees.languages.osc import values
from understudy.trees.languages.osc.dialects import Dialect
from understudy.trees.languages.osc.grammar import Part
from understudy.trees.languages.osc.library import PACKAGE, STANDARD
from understudy.trees.languages.osc.values import Constant
from understudy.trees.languages.text.source_map import LocatedProblem, Origin
from understudy.trees.source.problems import did_you_mean
from understudy.trees.source.value_reader import found_text

_USED = "osc.helpers", "osc.robotics", "osc.standard"


class Document:
    """The parts of a file, and the problems with them."""

    def __init__(self, file: Part, path: str, dialect: Dialect) -> None:
        self.problems: list[LocatedProblem] = []
        self.constants: dict[str, Constant] = {}
        """The parameters of the scenario."""
        self.main: Part | None = None
        """The behaviour of the scenario; None if it cannot be determined."""
        self.dialect = dialect
        self._path = path
        self._imports(file)
        scenarios = [
            scenario for declared in file.all("oscDeclaration") for scenario in declared.all("scenarioDeclaration")
        ]
        if not scenarios:
            self._note(
                file, "the text", f"has no scenario; give it one: scenario {dialect.scenario}: with {dialect.do} in it"
            )
        for other in scenarios[1:]:
            message = f"there is one in line {scenarios[0].line} already; {dialect.subject.a} is one scenario"
            self._note(other, _label(other), message)
        if scenarios:
            self._scenario(scenarios[0])

    def _imports(self, file: Part) -> None:
        statements = [found for prelude in file.all("preludeStatement") for found in prelude.all("importStatement")]
        names = [self._import(reference) for found in statements for reference in found.all("importReference")]
        if not any(names):
            self._note(file, "the text", f"does not import its library; begin it with: import {PACKAGE}")

    def _import(self, reference: Part) -> bool:
        """Return whether an import is that of our library, or was reported as wrong."""
        name = reference.text_of("structuredIdentifier")
        if name in (PACKAGE, STANDARD):
            return name == PACKAGE
        if not name:
            message = f"no files are read; write what is in that file here, and import {PACKAGE}"
        elif name in _USED:
            message = f"has behaviours that {self.dialect.subject.a} cannot have; import {PACKAGE} instead"
        else:
            message = f"there is no such library{did_you_mean(name, (PACKAGE, STANDARD))}"
        self._note(reference, f"import {reference.text:.60}", message)
        return True

    def _scenario(self, scenario: Part) -> None:
        label = _label(scenario)
        for member in scenario.all("scenarioMemberDecl"):
            for found in member.parts:
                self._member(found, label)
        directives = [done for specified in scenario.all("behaviorSpecification") for done in specified.parts]
        if not directives:
            self._note(scenario, label, f"does nothing; give it a do, such as {self.dialect.do} with the leaves in it")
        for other in directives[1:]:
            message = f"there is one in line {directives[0].line} already; put both into one {self.dialect.do}"
            self._note(other, "do", message)
        if directives:
            self.main = directives[0].first("doMember")

    def _member(self, found: Part, label: str) -> None:
        for declared in found.all("parameterDeclaration"):
            self._parameter(declared)
        if found.rule == "modifierInvocation":
            message = f"is written in the with: of the node that it is for, and not of {label}"
            self._note(found, f"{found.text_of('modifierName'):.60}()", message)
        elif found.rule != "fieldDeclaration":  # its words have been refused
            self._note(found, label, f"has something in it that no {self.dialect.subject.one} has; remove it")

    def _parameter(self, declared: Part) -> None:
        type_, default = declared.text_of("typeDeclarator"), declared.first("defaultValue")
        value = None
        label = f"parameter {declared.text_of('fieldName'):.60}"
        if type_ not in values.TYPES:
            self._note(declared, label, f"there is no type {found_text(type_)}{did_you_mean(type_, values.TYPES)}")
        elif default is None:
            self._note(declared, label, f"it has no value; write one after it, with = and {values.RIGHT[type_]}")
        else:
            try:
                value = values.read(default.parts[-1], type_, self.constants)
            except ValueError as error:
                self._note(default.parts[-1], label, str(error))
        for name in declared.all("fieldName"):
            if name.text in self.constants:
                self._note(name, f"parameter {name.text:.60}", "is given twice; remove one of them")
            self.constants[name.text] = Constant(type_, value)

    def _note(self, part: Part, label: str, message: str) -> None:
        self.problems.append(Origin(label, part.line, part.column).problem(self._path, message))


def _label(scenario: Part) -> str:
    return f"scenario {scenario.text_of('qualifiedBehaviorName'):.60}"
