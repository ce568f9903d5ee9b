"""Print what the image has to install: the dependencies of the project and of the extras that fly.

Left out: what only developers and comparisons need. ``python dependencies.py pyproject.toml``
"""

import sys
import tomllib

EXTRAS = ("report", "ulog")

with open(sys.argv[1], "rb") as file:
    project = tomllib.load(file)["project"]
wanted = [*project["dependencies"]]
for extra in EXTRAS:
    wanted += project["optional-dependencies"][extra]
sys.stdout.write("\n".join(wanted) + "\n")
