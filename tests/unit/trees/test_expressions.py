"""Conditions over messages: their values, when they are undecided, and that nothing but conditions is accepted."""

import ast
import contextlib
import math
from array import array

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.unit.trees.messages import Battery, Header, Pack, fields
from understudy.trees.source.expression_values import MOST_ELEMENTS, Undefined
from understudy.trees.source.expressions import Expression, ExpressionError

NAN, INF = math.nan, math.inf


def battery(**values: object) -> Battery:
    given_ = {
        "header": Header(frame_id="base"),
        "percentage": 0.5,
        "charging": False,
        "level": b"\x02",
        "name": "main",
        "cells": array("f", [3.5, 3.75, 4.0]),
        "covariance": [1.0, 0.0, 0.0, 2.0],
        "packs": [Pack(name="a", temperature=20.0), Pack(name="b", temperature=60.0)],
    }
    return Battery(**{**given_, **values})


def read(text: str) -> Expression:
    return Expression.parse(text, "t/msg/Battery", fields)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("percentage > 0.15", True),
        ("0.2 < percentage <= 0.5", True),
        ("0.5 < percentage < 1 / 0", False),  # the first comparison decides
        ("not charging and percentage >= 0.5", True),
        ("charging or percentage < 0.2", False),
        ("charging == False", True),
        ("charging", False),
        ("level == 2", True),
        ("name == 'main'", True),
        ("name != 'main' or len(name) == 4", True),
        ("cells[0] == 3.5 and cells[-1] == 4", True),
        ("len(cells) == 3", True),
        ("min(cells) > 3 and max(cells) < 5", True),
        ("max(percentage, 0.7, 0.6) == 0.7", True),
        ("max(cells) - min(cells) <= 0.5", True),
        ("abs(-percentage) * 4 == 2 and -3 % 2 == 1 and 1 + 1 == 2", True),
        ("sqrt(covariance[0] + covariance[3] + 1) == 2", True),
        ("packs[1].temperature > 50 and packs[0].name == 'a'", True),
        ("all(c > 3.4 for c in cells)", True),
        ("all(c > 3.6 for c in cells)", False),
        ("any(c > 3.9 for c in cells)", True),
        ("any(c > 4.1 for c in cells)", False),
        ("any(p.temperature > 50 for p in packs if p.name == 'a')", False),
        ("all(p.temperature < 50 for p in packs if p.name != 'b')", True),
        ("all(c > percentage for c in cells)", True),
        ("isfinite(percentage)", True),
    ],
)
def test_a_condition_is_evaluated(text, expected):
    assert read(text).holds(battery()) is expected
    assert Expression.parse(text).holds(battery()) is expected, "where the type isn't known"


@pytest.mark.parametrize(
    ("text", "values", "why"),
    [
        ("percentage > 0.15", {"percentage": NAN}, "percentage is NaN"),
        ("not percentage > 0.15", {"percentage": NAN}, "percentage is NaN"),
        ("percentage != percentage", {"percentage": NAN}, "percentage is NaN"),
        ("min(cells) > 3", {"cells": [3.5, NAN]}, "min(cells) is NaN"),
        ("max(cells) > 3", {"cells": [NAN, 3.5]}, "max(cells) is NaN"),
        ("all(c > 3 for c in cells)", {"cells": [3.5, NAN]}, "c is NaN"),
        ("1 / percentage > 3", {"percentage": 0.0}, "1 / percentage divides by 0"),
        ("1 % percentage > 3", {"percentage": 0.0}, "1 % percentage divides by 0"),
        ("cells[5] > 3", {}, "cells has 3 elements, and so no cells[5]"),
        ("cells[-4] > 3", {}, "cells has 3 elements, and so no cells[-4]"),
        ("min(cells) > 3", {"cells": []}, "cells has no elements"),
        ("sqrt(percentage) > 3", {"percentage": -1.0}, "sqrt(percentage) is of a negative number"),
        ("any(c > 9 for c in cells)", {"cells": [0.0] * (MOST_ELEMENTS + 1)}, "up to 4096 are gone through"),
        ("max(cells) > 9", {"cells": [0.0] * (MOST_ELEMENTS + 1)}, "up to 4096 are gone through"),
    ],
)
def test_an_undecided_condition_has_a_reason(text, values, why):
    with pytest.raises(Undefined) as caught:
        read(text).holds(battery(**values))
    assert why in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("not isfinite(percentage) or percentage > 0.15", True),
        ("percentage > 0.15 or not charging", True),
        ("percentage > 0.15 and charging", False),
        ("charging and percentage > 0.15", False),
        ("any(c > 3.9 for c in cells)", True),
        ("all(c > 3.9 for c in cells)", False),
        ("any(isfinite(c) and c > 9 for c in cells)", False),
        ("isfinite(percentage)", False),
    ],
)
def test_a_decisive_operand_decides_despite_an_undecided_one(text, expected):
    message = battery(percentage=NAN, cells=[NAN, 3.5, 4.0])
    assert read(text).holds(message) is expected


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "'' cannot be read; write a condition such as percentage > 0.15"),
        ("percentage >", "'percentage >' cannot be read; write a condition such as percentage > 0.15"),
        ("percentage > > 1", "cannot be read at character 14"),
        ("percentage", "percentage is a number, not true or false; compare it with something"),
        ("percentge > 1", "t/msg/Battery has no field 'percentge', did you mean 'percentage'?"),
        ("zz > 1", "t/msg/Battery has no field 'zz'; known are header, percentage, charging"),
        ("packs[0].temp > 1", "t/msg/Pack has no field 'temp'"),
        ("any(p.heat > 1 for p in packs)", "t/msg/Pack has no field 'heat'; known are name, temperature"),
        ("name > 3", "name is a string, not a number; compare it by == or !="),
        ("name == 3", "name is a string, but 3 is a number; compare values of the same type"),
        ("charging + 1 > 3", "charging is true or false, not a number; calculate with numbers"),
        ("cells > 3", "cells is an array, which cannot be compared; name a field or an element of it"),
        ("header == header", "header is a std_msgs/msg/Header, which cannot be compared"),
        ("percentage[0] > 3", "percentage is a number, not an array; remove [0]"),
        ("cells[percentage] > 3", "percentage is not an index; write a number, such as cells[0]"),
        ("cells[0:1] == 3", "0:1 is not an index"),
        ("percentage.real > 3", "percentage is a number, which has no field 'real'"),
        ("percentage ** 2 > 3", "percentage ** 2 is not allowed; use + - * / %"),
        ("percentage // 2 > 3", "not allowed"),
        ("percentage << 2 > 3", "not allowed"),
        ("~level > 3", "~level is not allowed; use not or -"),
        ("percentage in cells", "not allowed; use < <= > >= == !="),
        ("name is name", "not allowed; use < <= > >= == !="),
        ("'a' * 1000000000 == name", "'a' is a string, not a number; calculate with numbers"),
        ("'%999999999d' % 1 == name", "is a string, not a number"),
        ("1e999 > percentage", "1e999 is too large; a number is at most"),
        ("99999999999999999999999 > percentage", "is too large"),
        ("2j == 3", "2j is not allowed; write a number, a string, True or False"),
        ("None == 3", "None is not allowed"),
        ("pow(2, 9) > 3", "there is no function 'pow'"),
        ("absolute(2) > 3", "there is no function 'absolute'"),
        ("ab(2) > 3", "there is no function 'ab', did you mean 'abs'?"),
        ("eval('1') > 3", "there is no function 'eval'"),
        ("name.upper() == 'A'", "there is no function 'name.upper'"),
        ("abs(1, 2) > 3", "gives abs 2 values; it takes one, such as abs(x)"),
        ("abs() > 3", "abs() is not allowed; abs is given values, such as abs(x)"),
        ("max(*cells) > 3", "not allowed"),
        ("max(cells, key=abs) > 3", "not allowed"),
        ("len(percentage) > 3", "percentage is a number; len is given an array or a string"),
        ("min(packs) > 3", "packs has elements that are a t/msg/Pack; min is of numbers"),
        ("any(cells)", "cells cannot be iterated; write any(r < 0.2 for r in ranges)"),
        ("all([c > 1 for c in cells])", "cannot be iterated"),
        ("any(c > d for c in cells for d in cells)", "cannot be iterated"),
        ("any(any(c > d for d in cells) for c in cells)", "any inside of any or all is not allowed"),
        ("any(c > 1 for c in percentage)", "percentage is a number, not an array"),
        ("any(c > 1 for c in range(9))", "range(9) has no fields"),
        ("any(c > 1 for c, d in packs)", "is not a name for an element"),
        ("any(c > 1 for c in cells) and c > 1", "no field 'c'"),
        (" or ".join(["any(c > 1 for c in cells)"] * 5), "it has more than 4 any and all"),
        ("percentage if charging else 1", "is not allowed; use fields, numbers"),
        ("lambda: 1", "lambda: 1 is not allowed"),
        ("(x := 1) > 0", "is not allowed"),
        ("f'{name}' == 'a'", "is not allowed"),
        ("[1][0] > 0", "[1] has no fields"),
        ("name == '\\x41'", "found a backslash; write a string without one"),
        ("secret == 7", "t/msg/Battery has no field 'secret'"),
        ("__class__ == 1", "'__class__' cannot be a field of a message; the name of a field begins with a letter"),
        ("name.__class__ == 1", "'__class__' cannot be a field of a message"),
        ("header.__init__.__globals__ == 1", "'__init__' cannot be a field of a message"),
        ("().__class__ == 1", "() has no fields"),
        ("percentage > 1; charging", "cannot be read"),
        ("import os", "cannot be read"),
        ("1 < " + " + ".join(["level"] * 24), "it is more than 24 levels deep"),
        ("charging or " * 34 + "charging", None),
        (" or ".join(["level<9"] * 45), "it has more than 100 names, numbers and operations"),
        ("percentage > 0" + " " * 490 + "1", "it has 505 characters; 500 are allowed"),
        ("(" * 240 + "1" + ")" * 240, "cannot be read"),
        ("-" * 400 + "1 > 2", "it has more than 100 names"),
        ("not " * 40 + "charging", "it is more than 24 levels deep"),
    ],
)
def test_a_refused_condition_is_reported_with_the_valid_form(text, why):
    if why is None:
        assert read(text).holds(battery()) is False
        return
    with pytest.raises(ExpressionError) as caught:
        read(text)
    assert why in str(caught.value)


@pytest.mark.parametrize("name", ["secret", "get_fields_and_field_types", "update", "keys"])
def test_only_fields_are_accessible_if_the_type_is_unknown(name):
    with pytest.raises(Undefined, match=f"Battery has no field {name}"):
        Expression.parse(f"{name} == 7").holds(battery())
    with pytest.raises(Undefined, match=f"Pack has no field {name}"):
        Expression.parse(f"packs[0].{name} == 7").holds(battery())


@pytest.mark.parametrize(
    "text", ["name.real > 1", "percentage[0] > 1", "cells > 1", "name * 2 == name", "len(level) > 1"]
)
def test_a_value_of_an_unexpected_type_is_undecided(text):
    with pytest.raises(Undefined):
        Expression.parse(text).holds(battery())


def test_numpy_arrays_are_arrays():
    numpy = pytest.importorskip("numpy")
    message = battery(covariance=numpy.array([1.0, NAN, 3.0, 4.0]), cells=numpy.array([1, 2], dtype=numpy.float32))
    assert read("covariance[0] == 1 and len(covariance) == 4 and any(c > 3 for c in covariance)").holds(message)
    assert read("max(cells) == 2 and cells[0] == 1 and isfinite(cells[1])").holds(message)
    with pytest.raises(Undefined, match=r"covariance\[1\] is NaN"):
        read("covariance[1] > 0").holds(message)


def test_the_values_of_a_condition_are_reported():
    shown = read("percentage > 0.9 or charging or packs[0].name == 'x' or level > 5")
    assert_golden(
        "tree_problems", shown.values(battery()), "percentage is 0.5", "charging is false", "packs[0].name is 'a'"
    )
    assert read("cells[9] > 1 or min(cells) > 9").values(battery()) == "min(cells) is 3.5"
    assert read("all(c > 9 for c in cells)").values(battery()) == ""


WORDS = """
percentage charging level name cells covariance packs header c p temperature secret __class__ __globals__
get_fields_and_field_types mro eval exec open print getattr range pow abs min max len sqrt isfinite any all for in if
else not and or is lambda await yield None True False 0 1 2 -1 0.5 1e308 9999999999 18446744073709551616 'a' '%d' b'a'
f'{name}' ... ( ) [ ] { } , : ; . + - * / % ** // << | & ^ ~ @ < <= > >= == != := -> #
"""
NUMBERS = st.sampled_from(["percentage", "level", "cells[0]", "cells[7]", "0", "1", "0.5", "covariance[3]", "1e19"])
SUMS = st.recursive(
    NUMBERS,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*/%"), inner).map(" ".join).map("({})".format),
        st.tuples(st.sampled_from(["abs", "sqrt", "min", "max", "len"]), inner).map(
            lambda call: f"{call[0]}({call[1]})"
        ),
    ),
    max_leaves=6,
)
CONDITIONS = st.recursive(
    st.one_of(
        st.tuples(SUMS, st.sampled_from(["<", "<=", "==", "!=", ">"]), SUMS).map(" ".join).map("({})".format),
        SUMS.map("isfinite({})".format),
        SUMS.map("any(c > {} for c in cells)".format),
        SUMS.map("all(p.temperature < {} for p in packs if isfinite(p.temperature))".format),
        st.just("charging"),
    ),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(" ".join).map("({})".format),
        inner.map("(not {})".format),
    ),
    max_leaves=5,
)
FLOATS = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=500, deadline=None)
@given(
    text=st.one_of(
        st.text(max_size=60), st.lists(st.sampled_from([*WORDS.split(), "\n"]), max_size=25).map(" ".join), CONDITIONS
    ),
    percentage=FLOATS,
    cells=st.lists(FLOATS, max_size=5),
    level=st.binary(min_size=1, max_size=1),
    known=st.booleans(),
)
@example(text="10000000000 * " * 23 + "1 * percentage > 1", percentage=1e308, cells=[], level=b"a", known=False)
@example(
    text="isfinite(" + " * ".join(["9999999999999999999"] * 20) + ")", percentage=0.0, cells=[], level=b"a", known=True
)
def test_any_condition_is_refused_or_is_true_false_or_undecided(text, percentage, cells, level, known):
    message = battery(percentage=percentage, cells=array("d", cells), level=level)
    try:
        expression = Expression.parse(text, "t/msg/Battery", fields if known else None)
    except ExpressionError:
        return
    # Only what the language has got here.
    called = [node.func for node in ast.walk(ast.parse(text.strip(), mode="eval")) if isinstance(node, ast.Call)]
    assert {node.id for node in called} <= {"abs", "min", "max", "len", "sqrt", "isfinite", "any", "all"}
    assert "__" not in "".join(
        getattr(node, "attr", getattr(node, "id", "")) for node in ast.walk(ast.parse(text.strip(), mode="eval"))
    )
    with contextlib.suppress(Undefined):
        assert expression.holds(message) in (True, False)
    assert isinstance(expression.values(message), str)


@settings(max_examples=200, deadline=None)
@given(text=CONDITIONS, percentage=FLOATS, cells=st.lists(FLOATS, max_size=5))
def test_a_condition_and_its_negation_are_never_both_true(text, percentage, cells):
    message = battery(percentage=percentage, cells=array("d", cells))
    found = []
    for written in (text, f"not {text}"):
        try:
            found.append(read(written).holds(message))
        except ExpressionError:
            return
        except Undefined:
            found.append(None)
    assert found in ([True, False], [False, True], [None, None])
