"""How the documentation is built: `python -m sphinx -W --keep-going docs build/docs`."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "extensions")]

project = "speckle3d"
author = "The speckle3d developers"
copyright = "the speckle3d developers"
extensions = [
    "generated",  # settings, commands and the API, from the code
    "myst_nb",  # Markdown pages, and notebooks executed at each build
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",  # docstrings in numpydoc's form
    "sphinx-mathjax-offline",  # equations without a network
    "sphinx_copybutton",
]
html_theme = "furo"
html_title = "speckle3d"
exclude_patterns = ["build", "extensions"]

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True

nb_execution_mode = "cache"
nb_execution_timeout = 180
nb_execution_raise_on_error = True
nb_execution_in_temp = False

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
# Pages outside the documentation are named as they are in the repository.
suppress_warnings = ["myst.xref_missing", "ref.footnote"]
