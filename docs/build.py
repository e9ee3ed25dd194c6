"""The documentation as a site that reads offline: the pages of the repository, the Python reference, and a check of every link and
anchor.

    python docs/build.py target/site

Pages keep their places, so their links work here as they do in the repository; files and folders they link to come along.
"""

import ast
import inspect
import re
import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
NAV = """\
nav:
  - Start: README.md
  - Tutorials:
    - Ten minutes from nothing: docs/START.md
    - Your own robot: docs/OWN_ROBOT.md
    - Your own task: docs/TASKS.md
    - Guard your policy: docs/GUARD.md
    - Connect your robot: docs/CONNECT.md
    - From a recording to a running loop: docs/IMITATION.md
    - Read a flight log: docs/FLIGHT_LOG.md
    - Write a limit: docs/OWN_LIMIT.md
    - Examples: examples/README.md
  - Use:
    - Commands: docs/COMMANDS.md
    - Limits: docs/LIMITS.md
    - Training: docs/TRAINING.md
    - Demonstrations: docs/DEMONSTRATIONS.md
    - Environments: docs/ENVIRONMENTS.md
    - Policies made elsewhere: docs/POLICIES.md
    - What the doctor says: docs/DOCTOR.md
    - Faults: docs/FAULTS.md
    - Security: docs/SECURITY.md
    - Words: docs/GLOSSARY.md
  - Python: docs/PYTHON.md
  - Rust: docs/EMBED.md
  - Project:
    - Results: results/README.md
    - Architecture: docs/ARCHITECTURE.md
    - Contributing: CONTRIBUTING.md
    - Changes: CHANGELOG.md
"""
# Colours of code would come from another host and a search needs a server, but the theme's scripts ask for their elements all the same.
# Long lines of code go on below: the reference everywhere, drawings made of letters where there is room for them.
MAIN = """\
{% extends "base.html" %}
{% block extrahead %}<link id="hljs-light"><link id="hljs-dark"><style>
pre code.language-text { white-space: pre-wrap; overflow-wrap: anywhere; }
@media (min-width: 992px) { pre code { white-space: pre-wrap; } }
</style>{% endblock %}
{% block content %}{{ super() }}<div class="modal" id="mkdocs_search_modal"><div id="mkdocs-search-results"></div></div>{% endblock %}
"""
THEME = "theme:\n  name: mkdocs\n  color_mode: auto\n  highlightjs: false\n  shortcuts:\n    search: 0\n  custom_dir: "


def stage(folder: Path) -> None:
    """Every page, and what pages link to."""
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    waiting = [*pages, *(ROOT / "docs").glob("*.md"), *(ROOT / "results").rglob("README.md")]
    seen: set[Path] = set()
    while waiting:
        source = waiting.pop().resolve()
        if source in seen or not source.is_relative_to(ROOT):
            continue
        seen.add(source)
        if not source.exists():
            sys.exit(f"docs: '{source.relative_to(ROOT)}' is linked to and does not exist")
        place = folder / source.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            place.mkdir(exist_ok=True)
            if not (source / "README.md").exists():
                names = sorted(f"- [{f.name}]({f.name})" for f in source.iterdir() if f.is_file())
                (place / "README.md").write_text(f"# {source.name}\n\n" + "\n".join(names) + "\n")
            waiting += [f for f in source.iterdir() if f.is_file()]
            continue
        shutil.copyfile(source, place)
        if source.suffix == ".md":
            links = [link for link in LINK.findall(source.read_text()) if "://" not in link]
            waiting += [source.parent / unquote(link) for link in links]
            text = place.read_text()
            for link in links:  # a folder opens at its page
                if (source.parent / link).is_dir():
                    text = text.replace(f"]({link})", f"]({link.rstrip('/')}/README.md)")
            place.write_text(text)


def types(module: str) -> dict[str, str]:
    """What public functions, classes and values of a module take and give, as its source or its stub writes it, by a name with a dot."""
    source = ROOT / "python" / Path(*module.split("."))
    file = next(f for f in (source.with_suffix(".pyi"), source.with_suffix(".py"), source / "__init__.py") if f.exists())
    found = {}
    tree = ast.parse(file.read_text()).body
    classes = {node.name: node for node in tree if isinstance(node, ast.ClassDef)}
    for node in tree:
        inside = [node]
        if isinstance(node, ast.ClassDef):
            above = [classes[base.id] for base in node.bases if isinstance(base, ast.Name) and base.id in classes]
            inside = [item for of in (*above, node) for item in of.body]
        for function in (f for f in inside if isinstance(f, ast.FunctionDef)):
            takes = re.sub(r"^(self|cls)(, )?", "", ast.unparse(function.args))
            gives = ast.unparse(function.returns) if function.returns else ""
            if not isinstance(node, ast.ClassDef):
                found[function.name] = f"({takes}) -> {gives}"
            elif function.name in ("__new__", "__init__"):
                found[node.name] = f"({takes})"
            elif any(isinstance(d, ast.Name) and d.id == "property" for d in function.decorator_list):
                found[f"{node.name}.{function.name}"] = f": {gives}"
            else:
                found[f"{node.name}.{function.name}"] = f"({takes}) -> {gives}"
    return found


def reference(file: Path) -> None:
    """The Python package, from its docstrings and its types."""
    import nearl

    parts = ["# Python", inspect.getdoc(nearl) or ""]
    for name in sorted(n for n in nearl.__all__ if not n.startswith("_")):
        thing = getattr(nearl, name)
        known = types(getattr(thing, "__module__", None) or "nearl._core")
        parts.append(f"## nearl.{name}\n\n```text\nnearl.{name}{known.get(name, '')}\n\n{inspect.getdoc(thing) or ''}\n```")
        for member in vars(thing) if inspect.isclass(thing) else ():
            said = inspect.getdoc(getattr(thing, member))  # not of the `staticmethod` around it
            if not member.startswith("_") and said:
                typed = known.get(f"{name}.{member}", "")
                parts.append(f"### {name}.{member}\n\n```text\n{name}.{member}{typed}\n\n{said}\n```")
    file.write_text("\n\n".join(parts) + "\n")


class Links(HTMLParser):
    """Addresses inside one page, its anchors, and what it needs to be shown."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.anchors: set[str] = set()
        self.needed: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if value and key in ("href", "src"):
                self.found.append(value)
                self.needed += [value] if tag != "a" else []
            if value and key in ("id", "name"):
                self.anchors.add(value)


def dead_links(site: Path) -> list[str]:
    """Links of the site's pages that lead nowhere inside it, and what a page would have to fetch from elsewhere."""
    pages: dict[Path, Links] = {}
    for page in site.rglob("*.html"):
        if "rust" in page.relative_to(site).parts or page.name == "404.html":
            continue
        pages[page] = Links()
        pages[page].feed(page.read_text())
    dead = []
    for page, links in pages.items():
        dead += [f"{page.relative_to(site)}: needs {link}, which is not in the site" for link in links.needed if link.startswith(("http", "//"))]
        for link in links.found:
            if "://" in link or link.startswith(("mailto:", "data:")):
                continue
            path, _, anchor = link.partition("#")
            target = (page.parent / unquote(path.split("?")[0])).resolve() if path else page.resolve()
            there = pages.get(target)
            if not target.exists() or (there and anchor and unquote(anchor) not in there.anchors):
                dead.append(f"{page.relative_to(site)}: {link}")
    return dead


def main(site: Path) -> int:
    """Builds the site into ``site``; 1 where a link is dead."""
    site = site.resolve()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        stage(work / "pages")
        reference(work / "pages" / "docs" / "PYTHON.md")
        (work / "theme").mkdir()
        (work / "theme" / "main.html").write_text(MAIN)
        settings = f"site_name: NEARL\ndocs_dir: pages\nsite_dir: {site}\nuse_directory_urls: false\nplugins: []\n"
        (work / "mkdocs.yml").write_text(f"{settings}{THEME}{work / 'theme'}\n{NAV}")
        subprocess.run([sys.executable, "-m", "mkdocs", "build", "--quiet", "--config-file", work / "mkdocs.yml"], check=True)
    if (rust := ROOT / "target" / "doc").is_dir():
        shutil.copytree(rust, site / "rust", dirs_exist_ok=True)
    dead = dead_links(site)
    print("\n".join(dead) or f"{site / 'index.html'}: {sum(1 for _ in site.rglob('*.html'))} pages, no dead link")
    return 1 if dead else 0


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit("docs/build.py: say the folder of the site: python docs/build.py target/site")
    sys.exit(main(Path(sys.argv[1])))
