"""Settings of Sphinx, which builds the documentation site: `make docs`."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import quad_gym  # noqa: E402
from docs.renewal.release import facts  # noqa: E402

project = "quad_gym"
author = "The quad_gym developers"
copyright = author
version = release = quad_gym.__version__
html_baseurl = facts()["site"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "extensions.browser_page",
    "extensions.docstrings",
    "extensions.environment_pages",
    "extensions.equations",
    "extensions.films",
]
exclude_patterns = ["_build", "gallery", "paper", "tutorials/*.ipynb", "tutorials/*.py"]
suppress_warnings = [
    "config.cache",  # settings of the gallery are objects
    # CONTRIBUTING.md and CHANGELOG.md are at the top of the repository and are included here
    "myst.header",
]

myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # notebooks are committed with their outputs
nb_merge_streams = True  # prints of one cell are one block

# single backticks in docstrings are names, with links to their documentation
default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
python_display_short_literal_types = True
python_maximum_signature_line_length = 80
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_custom_sections = ["Source"]

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "tutorials",
    "filename_pattern": r"\.py$",
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": "extensions.gallery.LessonOrder",
    "abort_on_example_error": False,
    "only_warn_on_example_error": True,  # which ends the build, as warnings are errors
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "capture_repr": (),  # examples print their results
    "min_reported_time": 1e9,
    "remove_config_comments": True,
    "reset_modules": ("matplotlib", "extensions.gallery.reset"),
    "thumbnail_size": (640, 400),
    "write_computation_times": False,
}

html_math_renderer = "pictures"
html_theme = "furo"
html_title = f"quad_gym {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"top_of_page_buttons": []}
