"""The documentation as a site: `make docs` writes out/docs/index.html, without a network."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import numpy.typing
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.ext.autodoc.mock import mock
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.logging import getLogger

sys.path.insert(0, str(Path(__file__).parent / "inventories"))
from make_inventories import PROJECTS

project = "softmode"
author = "the softmode authors"
copyright = "the softmode authors, Apache-2.0"
release = importlib.metadata.version("softmode")

# A builtin such as `object` in an annotation is also the name of fields; the builtin is meant.
suppress_warnings = ["ref.python"]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
# The site builds without the extras: what is not installed is mocked, and only that.
_EXTRAS = (
    "matplotlib",
    "pyarrow",
    "pxr",
    "rerun",
    "rsl_rl",
    "skrl",
    "stable_baselines3",
    "tensordict",
    "torch",
    "viser",
)
autodoc_mock_imports = [name for name in _EXTRAS if importlib.util.find_spec(name) is None]
napoleon_numpy_docstring = False
napoleon_use_rtype = False

default_role = "code"  # what stands in single backticks is code, as in Markdown
toc_object_entries_show_parents = "hide"
add_module_names = False

# Links to other projects, from inventories that lie in the repository: nothing is fetched.
intersphinx_mapping = {name: (other.url, f"inventories/{name}.inv") for name, other in PROJECTS.items()}

html_theme = "furo"
html_title = "softmode"
html_logo = "images/logo.svg"
html_favicon = "images/favicon.svg"
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
html_math_renderer = "mathml"  # set in the page itself: a reader needs no network either

_DESCRIPTIONS: dict[str, list[str]] = {}
_PUBLIC: dict[str, str] = {}
"""The public path of what lives in a module, by module and name."""


def _keep(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Make plain docstrings fit for reStructuredText: |x| is a norm, and formulas set in stay as they are."""
    plain = [line.replace("|", "\N{DIVIDES}") for line in lines]
    lines.clear()
    before = ""  # the last line that is not empty
    for k, line in enumerate(plain):
        if line.startswith("    ") and k and not plain[k - 1] and re.match(r"[^\s\-.=]", before):
            if not before.endswith("::"):
                lines += ["::", ""]
        lines.append(line)
        before = line or before
    if what in ("attribute", "data", "property"):
        _DESCRIPTIONS[name] = list(lines)


def _restore(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Undo what napoleon makes of a field's description: it takes the words before the first colon for a type."""
    if what in ("attribute", "data", "property"):
        lines[:] = _DESCRIPTIONS.pop(name)


def _face(name: str) -> dict[str, Any]:
    """Return the public names of a package, and what they are; names are imported with missing extras mocked."""
    module = importlib.import_module(name)
    with mock(autodoc_mock_imports):
        return {public: getattr(module, public) for public in getattr(module, "__all__", ())}


def _constant(package: str, name: str, value: Any) -> list[str]:
    """Return the entry of a constant, described by the string below it in its own module."""
    homes = [home for home in sorted(sys.modules) if home.startswith(f"{package}.")]
    for home in homes:
        if vars(sys.modules[home]).get(name) is value:
            text = ModuleAnalyzer.for_module(home).find_attr_docs().get(("", name))
            if text:
                return [f".. py:data:: {name}", "", *(f"   {line}" for line in text)]
    raise LookupError(f"{package}.{name} has no description")


def _reference(match: re.Match[str]) -> str:
    """Return a block of the reference: the table of a package's names, or the entries of those listed or of all."""
    kind, package, listed = match.groups()
    public = _face(package)
    lines = ["```{eval-rst}", f".. currentmodule:: {package}", ""]
    if kind == "summary":
        lines += [".. autosummary::", "   :nosignatures:", ""]
        return "\n".join([*lines, *(f"   {name}" for name, value in public.items() if callable(value)), "```"])
    for name in listed.split() or public:
        if callable(public[name]):
            lines.append(f".. auto{'class' if isinstance(public[name], type) else 'function'}:: {name}")
        else:
            lines += _constant(package, name, public[name])
    return "\n".join([*lines, "```"])


def _resolve(app: Any, env: Any, node: Any, shown: Any) -> Any:
    """Link a name that a docstring gives by its module to where its package offers it."""
    if not _PUBLIC:
        pages = "".join(page.read_text() for page in app.srcdir.joinpath("api").glob("*.md"))
        for face in dict.fromkeys(re.findall(r"^```\{entries\} (\S+)$", pages, re.M)):
            for name, value in _face(face).items():
                _PUBLIC[f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '')}"] = f"{face}.{name}"
    target = node.get("reftarget", "")
    for end in (target, target.rpartition(".")[0]):
        if end in _PUBLIC and node.get("refdomain") == "py":
            place = _PUBLIC[end] + target[len(end) :]
            return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, "obj", place, node, shown)
    return None


def _read(app: Any, page: str, source: list[str]) -> None:
    """Adapt a page to the site: links called after their files, as is right elsewhere, get the titles of their pages.

    Patterns of the index that stand for pages not there, which Sphinx cannot be told not to mention, are dropped.
    """
    if page == "index":
        folder = Path(app.srcdir)
        lines = source[0].splitlines()
        source[0] = "\n".join(line for line in lines if not line.endswith("*") or list(folder.glob(f"{line}.md")))
    source[0] = re.sub(r"^```\{(summary|entries)\} (\S+)\n(.*?)^```$", _reference, source[0], flags=re.M | re.S)
    source[0] = re.sub(r"\[[\w/]+\.md\]\(([^)]+\.md)\)", r"[](\1)", source[0])


def _shorten(app: Any, what: str, name: str, obj: Any, options: Any, signature: str, result: str) -> Any:
    """Write defaults that a factory makes as dots: the signature is then Python, and is set as such."""
    return (signature or "").replace("<factory>", "...") or None, result


class _Named(type):
    """Types that are called as they are written."""

    def __getitem__(cls, item: Any) -> Any:
        name = getattr(item, "__name__", "Any")
        return _Named(f"{cls.__name__}[{name}]", (), {"__module__": "builtins"})


# numpy.typing's aliases expand to what no reader wants to see. This stands before the first import of softmode.
for _alias in ("NDArray", "ArrayLike"):
    setattr(numpy.typing, _alias, _Named(_alias, (), {"__module__": "builtins"}))


def _mathml(node: Any, *, as_block: bool) -> str:
    """Return a formula as MathML, or as it was written with a warning."""
    try:
        return tex2mathml(node.astext(), as_block=as_block)
    except MathError as error:
        getLogger(__name__).warning("formula %r: %s", node.astext(), error, location=node)
        return node.astext()


def _inline_math(writer: Any, node: Any) -> None:
    """Write a formula within a line."""
    writer.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def _block_math(writer: Any, node: Any) -> None:
    """Write a formula that stands by itself."""
    writer.body.append(f'<div class="math">{_mathml(node, as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Put the two hooks on docstrings around napoleon, whose priority is 500."""
    app.connect("autodoc-process-docstring", _keep, priority=400)
    app.connect("autodoc-process-docstring", _restore, priority=600)
    app.connect("autodoc-process-signature", _shorten)
    app.connect("source-read", _read)
    app.connect("missing-reference", _resolve)
    app.add_html_math_renderer("mathml", inline_renderers=(_inline_math, None), block_renderers=(_block_math, None))
