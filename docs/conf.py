"""How ``make docs`` turns these pages and the docstrings into a website, without a look at the network."""

from docutils.nodes import Element, TextElement
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import nlfilter_torch

project = "nlfilter-torch"
version = release = nlfilter_torch.__version__
author = copyright = "The nlfilter-torch maintainers"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"nlfilter-torch {release}"
html_show_sphinx = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["tables.css"]

myst_heading_anchors = 3
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and ranges; signatures would drown in unions
autodoc_mock_imports = ["deepinv"]  # optional, with a build of torchvision for the installed torch
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True

# A reference from a docstring that leads nowhere is an error, but for other libraries and for what is not public.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(collections|torch|numpy|matplotlib|deepinv|sklearn)\..*"),
    ("py:mod", r"nlfilter_torch(\.\w+)+"),
    ("py:class", r"nlfilter_torch(\.[a-z_]+)+\.\w+"),
]


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: TextElement) -> Element | None:
    """Find a public name that a docstring mentions without the package that the reference lists it under."""
    if node.get("refdomain") != "py":
        return None
    name = (
        node["reftarget"].rpartition(".")[2] if node["reftarget"].startswith("nlfilter_torch.") else node["reftarget"]
    )
    domain = env.get_domain("py")
    for package in ("nlfilter_torch", "nlfilter_torch.photo"):
        if f"{package}.{name}" in domain.objects:
            node["reftarget"] = f"{package}.{name}"
            return domain.resolve_xref(
                env, node["refdoc"], app.builder, node["reftype"], node["reftarget"], node, shown
            )
    return None


def setup(app: Sphinx) -> None:
    """Register the search for names."""
    app.connect("missing-reference", resolve)
