"""The guide's example runs as it stands, warnings as errors, and leaves nothing."""

from __future__ import annotations

import re

import pytest

from tests.paths import ROOT

pytest_plugins = ("pytester",)
GUIDE = ROOT / "docs" / "testing.md"


@pytest.mark.system
def test_the_guides_example_passes_as_it_stands(pytester: pytest.Pytester) -> None:
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    code = "\n\n".join(blocks)
    pytester.makepyfile(test_lab=code)
    result = pytester.runpytest_subprocess("-W", "error", "-p", "no:randomly", timeout=150)
    result.assert_outcomes(passed=code.count("def test_") + 1)  # one is parametrised by two
