"""The tests."""

import pytest

# An assert of a helper shows what differs, as one of a test does.
pytest.register_assert_rewrite("tests.support")
