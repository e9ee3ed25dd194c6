"""The documentation as a site that reads offline: the pages of the repository, the Python reference, and a check of every link.

    python docs/build.py target/site

Pages keep their places, so their links work here as they do in the repository; files and folders they link to come along.
"""

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
  - Ten minutes from nothing: docs/START.md
  - Commands: docs/COMMANDS.md
  - Tasks: docs/TASKS.md
  - Train for your own robot: docs/OWN_ROBOT.md
  - Guard your policy: docs/GUARD.md
  - Write a limit: docs/OWN_LIMIT.md
  - Examples: examples/README.md
  - Limits: docs/LIMITS.md
  - Training: docs/TRAINING.md
  - Demonstrations: docs/DEMONSTRATIONS.md
  - From a recording to a running loop: docs/IMITATION.md
  - Environments: docs/ENVIRONMENTS.md
  - Policies made elsewhere: docs/POLICIES.md
  - Connecting a robot: docs/CONNECT.md
  - Embedding in Rust: docs/EMBED.md
  - Reading a flight log: docs/FLIGHT_LOG.md
  - What the doctor says: docs/DOCTOR.md
  - Faults: docs/FAULTS.md
  - Security: docs/SECURITY.md
  - Words: docs/GLOSSARY.md
  - Architecture: docs/ARCHITECTURE.md
  - Python: docs/PYTHON.md
  - Results: results/README.md
  - Contributing: CONTRIBUTING.md
  - Changes: CHANGELOG.md
"""


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


def reference(file: Path) -> None:
    """The Python package, from its docstrings."""
    import nearl

    parts = ["# Python", inspect.getdoc(nearl) or ""]
    for name in sorted(n for n in nearl.__all__ if not n.startswith("_")):
        thing = getattr(nearl, name)
        parts.append(f"## nearl.{name}\n\n```text\n{inspect.getdoc(thing) or ''}\n```")
        members = vars(thing).items() if inspect.isclass(thing) else ()
        for member, value in members:
            text = inspect.getdoc(value)
            if not member.startswith("_") and text:
                parts.append(f"### {name}.{member}\n\n```text\n{text}\n```")
    file.write_text("\n\n".join(parts) + "\n")


class Links(HTMLParser):
    """Addresses inside one page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for key, value in attrs if key in ("href", "src") and value]


def dead_links(site: Path) -> list[str]:
    """Links of the site's pages that lead nowhere inside it."""
    dead = []
    for page in site.rglob("*.html"):
        if "rust" in page.relative_to(site).parts or page.name == "404.html":
            continue
        links = Links()
        links.feed(page.read_text())
        for link in links.found:
            path = unquote(link.split("#")[0].split("?")[0])
            if "://" not in link and not link.startswith(("mailto:", "data:")) and path and not (page.parent / path).exists():
                dead.append(f"{page.relative_to(site)}: {link}")
    return dead


def main(site: Path) -> int:
    """Builds the site into ``site``; 1 where a link is dead."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        stage(work / "pages")
        reference(work / "pages" / "docs" / "PYTHON.md")
        settings = f"site_name: NEARL\ndocs_dir: pages\nsite_dir: {site.resolve()}\nuse_directory_urls: false\ntheme:\n  name: mkdocs\n  color_mode: auto\n"
        (work / "mkdocs.yml").write_text(settings + "plugins: []\n" + NAV)
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
