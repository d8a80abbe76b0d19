"""Prints what a pyproject.toml requires, with the extras that are named: pip installs a project only together with its code."""

import sys
import tomllib
from pathlib import Path

project = tomllib.loads(Path(sys.argv[1]).read_text())["project"]
print("\n".join(project["dependencies"]))
for extra in sys.argv[2:]:
    print("\n".join(project["optional-dependencies"][extra]))
