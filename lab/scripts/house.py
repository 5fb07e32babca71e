#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""The bars of the project's rules: checks of README, book and source code.

    house.py [--quick] [--bin-dir target/release]     prints `bar NAME VALUE LIMIT ok|short`; exit status 1 when one is short
    house.py --measure-build [REVISION]               also builds `entire` at a revision (default 5c08403) and at HEAD, and
                                                      `entire-core` at HEAD; compares the builds' processor seconds

--quick leaves out what needs cargo or built programs; with --bin-dir, it uses built programs. Needs Python 3.9 and git.
Without a C compiler, the bar of the book's code blocks is short.
"""
import argparse
import os
import re
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import circles
import reach
import walks
from bar_lines import Bars

ROOT = Path(__file__).resolve().parents[2]

README_LINES = 90
FIRST_CODE_LINE = 40
FILE_LINES = 700
# Crates that a renderer embeds, and the upper limit of public items of each.
FRONT_CRATES = ("core", "steer")
PUBLIC_ITEMS = 130
RUST_LINES = 85_000
# Limits for `core` alone: lines without tests, and crates that it needs, itself included.
INFERENCE_LINES = 10_000
INFERENCE_CRATES = 12
# Limits of cyclic dependencies between files (see circles.py): number of cycles, and files of the largest.
CIRCLES = 3
CIRCLE_FILES = 3
# Limits of builds from nothing: processor seconds of a release build of `entire`, divided by those at the revision BEFORE;
# processor seconds of `cargo build --package entire-core`.
BEFORE = "5c08403"
ENTIRE_BUILD, CORE_BUILD_S = 0.75, 15
# Units of measured figures.
UNIT = r"%|(?:[µm]?s|dB|[KMG]i?B)\b"
# The rows of README's section Five numbers, by the beginnings of their names. A row has one or two figures: with entire, and
# for comparison. Each figure has: section of docs/src/results.md, beginning of the row's name, column, index of the number
# in the cell.
README_FIGURES = {
    "late frames": (
        ("Steering by wall time", "entire", 1, 0),
        ("Steering by wall time", "mean of the last three frames", 1, 0),
    ),
    r"mean of \|frame time − target\| / target in VTK": (
        ("Inside VTK", "vtkEntireSteering, cold", 1, 0),
        ("Inside VTK", "AutoAdjustSampleDistances", 1, 0),
    ),
    "time that steering adds to a frame in VTK": (("Inside VTK", "vtkEntireSteering, cold", 4, 0),),
    r"median of \|predicted / measured − 1\|": (("Calibration on another machine", "unshaded, unseen members", 2, 4),),
    "render farm": (
        ("Render farms", "queue, longest predicted first", 2, 0),
        ("Render farms", "queue in random order", 2, 0),
    ),
}
# Limits of the number of files that a reader visits to follow a value (see walks.py).
WALKS = {"plan": 4, "calibrate": 12, "steer": 12, "train": 8}
# Crates that only studies use.
STUDY_CRATES = ("forust-ml", "image-compare")
SOURCE_ROOMS = ("core", "steer", "io", "report", "train", "farm", "ffi", "cli", "vk-raycaster", "explore", "plugins", "lab")
SOURCES = (".rs", ".c", ".cxx", ".cpp", ".h", ".hpp", ".py", ".sh", ".wgsl")
# Languages of the code blocks for a reader who embeds the library.
EMBEDDING = ("c", "cpp", "python", "rust")
# Folders whose paths are checked where a page names them in backquotes.
ROOMS = SOURCE_ROOMS + ("include", "tests", "fuzz", "examples", "docs", "models", "data", "make", "scripts")


def run(*command, **options):
    return subprocess.run(command, cwd=ROOT, text=True, capture_output=True, **options)


def tracked(*patterns):
    """Returns the files that git tracks or does not ignore, as paths from the root."""
    listed = run("git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *patterns, check=True)
    return sorted(p for p in set(listed.stdout.splitlines()) if (ROOT / p).is_file())


# ---------------------------------------------------------------------------------------------------------- Markdown


class Page:
    """A Markdown file: its text without code, its code spans, and its fenced blocks."""

    def __init__(self, path):
        self.path = path
        self.lines = (ROOT / path).read_text(encoding="utf-8").splitlines()
        self.blocks = []  # (line number, language, lines)
        self.prose = []  # (line number, text)
        fence = None
        for number, line in enumerate(self.lines, 1):
            mark = re.match(r"\s*```(\w*)", line)
            if mark and fence is None:
                fence = (number, mark.group(1), [])
            elif mark:
                self.blocks.append(fence)
                fence = None
            elif fence is not None:
                fence[2].append(line)
            else:
                self.prose.append((number, line))

    def spans(self):
        """Code spans, also those that continue in the next line."""
        text = "\n".join(line for _, line in self.prose)
        return [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]

    def shell(self):
        """Command lines: code spans, and the lines of shell blocks with their continuations joined."""
        found = self.spans()
        for _, language, lines in self.blocks:
            if language in ("sh", "bash", "console", ""):
                found += re.sub(r"\\\n\s*", " ", "\n".join(lines)).splitlines()
        return [line.split(" # ")[0].strip() for line in found]

    def anchors(self):
        """Returns the anchors of the headings, as code hosts and mdBook make them."""
        found = set()
        for _, line in self.prose:
            heading = re.match(r"#{1,6} +(.*)", line)
            if heading:
                text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.group(1)).strip().lower()
                found.add(re.sub(r"[^\w\- ]", "", text).replace(" ", "-"))
        return found

    def sections(self):
        """The text from each heading to the next, headings and code included."""
        starts = [number - 1 for number, line in self.prose if re.match(r"#{1,6} ", line)]
        for start, end in zip([0, *starts], [*starts, len(self.lines)]):
            yield "\n".join(self.lines[start:end])

    def links(self):
        """(line number, target) of every link and picture that is not an address."""
        for number, line in self.prose:
            plain = re.sub(r"`[^`]*`", "", line)
            for target in re.findall(r"\]\(\s*<?([^)\s>]+)", plain):
                if not re.match(r"[a-z][a-z0-9+.-]*:", target):
                    yield number, target


def broken_links(pages):
    by_path = {(ROOT / page.path).resolve(): page for page in pages}
    book = (ROOT / "docs/src").resolve()
    for page in pages:
        here = (ROOT / page.path).resolve()
        for number, target in page.links():
            name, _, anchor = target.partition("#")
            to = (here.parent / name).resolve() if name else here
            if not to.exists():
                yield f"{page.path}:{number}: {target} does not exist"
            elif book in here.parents and book not in to.parents:
                yield f"{page.path}:{number}: {target} leaves the book"
            elif anchor and to in by_path and anchor not in by_path[to].anchors():
                yield f"{page.path}:{number}: {target}: there is no such heading"


def missing_paths(pages):
    """Paths of the repository that a page names in backquotes and that do not exist."""
    for page in pages:
        folder = (ROOT / page.path).parent
        for span in page.spans():
            if not re.fullmatch(r"[\w.+-]+(/[\w.+-]+)*/?", span) or span.split("/")[0] not in ROOMS or "/" not in span:
                continue
            if not ((ROOT / span).exists() or (folder / span).exists()):
                yield f"{page.path}: `{span}` does not exist"


def missing_names(pages):
    """Yields names of the C library that occur in the pages' code but not in the C headers."""
    header = "".join((ROOT / "include/entire" / name).read_text(encoding="utf-8") for name in ("entire.h", "advanced.h"))
    known = set(re.findall(r"\w+", header))
    # Modules and packages of other languages.
    known |= {"entire_vtk", "entire_paraview", "entire_core", "entire_steer", "entire_farm", "entire_static"}
    for page in pages:
        code = page.spans() + [line for _, _, lines in page.blocks for line in lines]
        for name in set(re.findall(r"\b(?:entire_[a-z0-9_]*[a-z0-9]|ENTIRE_(?:OBSERVE|CHANGE|UNIT|CAMERA|VOXELS)_\w+)\b", "\n".join(code))):
            if name not in known and f"{name}_" not in header:
                yield f"{page.path}: the C headers have no {name}"


def rows_of(page, heading):
    """Returns the tables' rows of a section, as lists of cells."""
    section = next((text for text in page.sections() if re.match(rf"#+ {re.escape(heading)}\n", text)), "")
    lines = re.findall(r"^\|(.*)\|$", section, re.M)
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)] for line in lines]


def figures_in(cell):
    """Returns the numbers of a cell with their units. A number without a unit has the next unit in the cell."""
    found = re.findall(rf"(?<![\w.])(\d+(?:\.\d+)?)(?:\s*({UNIT}))?", cell)
    unit, figures = "", []
    for number, own in reversed(found):
        unit = own or unit
        figures.insert(0, (number, unit))
    return figures


def figures_apart_from_results(readme, results):
    """Yields the figures of README that differ from docs/src/results.md. README_FIGURES states where each figure stands."""
    rows = rows_of(readme, "Five numbers")[2:]
    if [row[0].split(",")[0].split(":")[0].split(" after")[0] for row in rows] != list(README_FIGURES):
        yield f"README.md: the rows of Five numbers are not those of house.py: {', '.join(README_FIGURES)}"
        return
    for row, sources in zip(rows, README_FIGURES.values()):
        for cell, source in zip(row[1:3], (*sources, None)):
            # The name of a method may contain a number; its figure is the last one.
            stated, expected = figures_in(cell)[-1:] if cell else [], []
            if source:
                heading, name, column, index = source
                named = [r for r in rows_of(results, heading) if r[0].replace("*", "").startswith(name)]
                expected = figures_in(named[0][column])[index:index + 1] if named else []
            if stated != expected or source and not expected:
                yield f"README.md: {row[0]}: {cell or 'no figure'}, but results.md has {expected or 'no such figure'}"
        if len(figures_in(row[1])) != 1:
            yield f"README.md: {row[0]}: {row[1]} is not one figure"
    for number, line in readme.prose:
        if not line.startswith("|") and re.search(rf"\d\s*({UNIT})", line):
            yield f"README.md:{number}: a measured figure outside of Five numbers: {line[:60]}"


def make_targets():
    found = set()
    for name in ["Makefile", *tracked("make/*.mk")]:
        for line in (ROOT / name).read_text(encoding="utf-8").splitlines():
            rule = re.match(r"([A-Za-z0-9_-]+(?: [A-Za-z0-9_-]+)*):(?!=)", line)
            if rule:
                found.update(rule.group(1).split())
    return found


def missing_targets(pages):
    known = make_targets()
    for page in pages:
        for line in page.shell():
            for target in re.findall(r"(?:^|[\s;&(])make ([a-z][a-z0-9-]*)(?![\w=…*-])", line):
                if target not in known:
                    yield f"{page.path}: `make {target}` is no target"


def missing_examples():
    """Yields the example programs that a script or makefile builds, but no crate has. Cargo does not notice a missing
    example."""
    has = {Path(path).stem for path in tracked("*/examples/*.rs")}
    has |= {Path(path).parts[-2] for path in tracked("*/examples/*/main.rs")}
    for path in tracked("Makefile", "make/*", "*.sh", "*.py"):
        for name in re.findall(r"--example[\"',\s]+([a-z]\w*)", (ROOT / path).read_text(encoding="utf-8")):
            if name not in has:
                yield f"{path}: no crate has the example {name}"


class Helps:
    """Texts of the built programs' `--help`, read once for each command."""

    def __init__(self, folder):
        self.folder = folder
        self.texts = {}

    def __call__(self, program, *command):
        key = (program, *command)
        if key not in self.texts:
            done = run(str(self.folder / program), *command, "--help", timeout=60)
            self.texts[key] = done.stdout if done.returncode == 0 else None
        return self.texts[key]

    def commands(self, *words):
        """The commands of a program that have options, as tuples of words."""
        listed = re.search(r"^Commands:\n((?: +.*\n)+)", self(*words) or "", re.M)
        below = re.findall(r"^  ([a-z][a-z-]*)", listed.group(1), re.M) if listed else []
        found = [command for name in below if name != "help" for command in self.commands(*words, name)]
        return found or [words]

    def options(self, *words):
        text = re.split(r"^Examples?\b", self(*words) or "", flags=re.M)[0]
        found = set(re.findall(r"^(?: {6}|  -\w, )(--[a-z][a-z-]*)", text, re.M))
        return sorted(found - {"--help", "--version"})


def undocumented_options(pages, text_of):
    """Options that no section mentions together with their command."""
    sections = [section for page in pages for section in page.sections()]
    for command in (c for program in ("entire", "entire-lab") for c in text_of.commands(program)):
        name = re.compile(rf"(?<![\w-]){re.escape(' '.join(command))}(?![\w-])")
        told = set()
        for section in filter(name.search, sections):
            told.update(re.findall(r"(?<![\w-])--[a-z][a-z-]*", section))
        for option in text_of.options(*command):
            if option not in told:
                yield f"{' '.join(command)} {option}"


def missing_commands(pages, text_of):
    """Commands and options in pages that `--help` lacks."""
    for page in pages:
        for line in page.shell():
            for part in re.split(r"\s*(?:\||&&|;)\s+", line):
                words = part.split()
                while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                    words.pop(0)
                # A page may name the program's folder, as in `target/release/entire`.
                words[:1] = [word.rpartition("/")[2] for word in words[:1]]
                if len(words) < 2 or words[0] not in ("entire", "entire-lab") or not re.fullmatch(r"[a-z][a-z-]*", words[1]):
                    continue
                text = text_of(words[0], words[1])
                if text is None:
                    yield f"{page.path}: `{words[0]} {words[1]}` is no command"
                    continue
                if len(words) > 2 and re.fullmatch(r"[a-z]+", words[2]):
                    # A subcommand of the command, such as `paper train`, has its own options.
                    text += text_of(*words[:3]) or ""
                for option in re.findall(r"(?<!\S)--[a-z][a-z-]*", " ".join(words[2:])):
                    if not re.search(re.escape(option) + r"(?![a-z-])", text):
                        yield f"{page.path}: `{words[0]} {words[1]}` has no option {option}"


def broken_snippets(pages):
    """Yields C and C++ blocks that use the C library and do not compile, and Python blocks with syntax errors."""
    compilers = {"c": ("cc", "-std=c11", "-xc", "names.h"), "cpp": ("c++", "-std=c++17", "-xc++", "names.hpp")}
    for page in pages:
        for number, language, lines in page.blocks:
            text = "\n".join(lines)
            if language == "python":
                try:
                    compile(text, page.path, "exec")
                except SyntaxError as error:
                    yield f"{page.path}:{number}: {error}"
            if language not in compilers or not re.search(r"\bentire(_|::)", text):
                continue
            compiler, standard, kind, names = compilers[language]
            body = "\n".join(line for line in lines if not line.startswith("#include"))
            program = f'#include "{names}"\nvoid snippet(void) {{\n{body}\n}}\n'
            command = [compiler, standard, kind, "-fsyntax-only", "-Wall", "-Wno-unused", f"-I{ROOT}/include", f"-I{ROOT}/docs/snippets", "-"]
            done = run(*command, input=program)
            if done.returncode != 0 or done.stderr:
                first = [line for line in done.stderr.splitlines() if "error" in line or "warning" in line][:3]
                yield f"{page.path}:{number}: " + "; ".join(first or ["does not compile"])


# ------------------------------------------------------------------------------------------------------------- source


def file_lengths():
    for path in tracked(*SOURCE_ROOMS):
        if path.endswith(SOURCES):
            with open(ROOT / path, encoding="utf-8", errors="replace") as lines:
                yield sum(1 for _ in lines), path


def clause_definitions():
    """Yields the comments whose first word makes them a clause instead of a definition ("What a frame may cost")."""
    begin = re.compile(r'\s*(?://[/!]?|/\*\*?|#|"""|--) ?(What|Whether|How|Where|Who|Whose)\b(?!.*\?$)')
    for path in tracked(*SOURCE_ROOMS, "tests", "fuzz", "examples", "scripts", "include"):
        if path.endswith(SOURCES):
            before = ""
            for number, line in enumerate((ROOT / path).read_text(encoding="utf-8", errors="replace").splitlines(), 1):
                if begin.match(line) and not re.match(r"\s*(//|#|\*)", before):
                    yield f"{path}:{number}: {line.strip()[:80]}"
                before = line


def dependency_tree(package, edges, *options):
    """Names of the crates that a package needs by these kinds of dependencies, itself included."""
    done = run("cargo", "tree", "--package", package, "--edges", edges, "--prefix", "none", *options)
    if done.returncode != 0:
        raise SystemExit(f"house: cargo tree: {done.stderr.strip()}")
    return {line.split()[0] for line in done.stdout.splitlines() if line.strip()}


def addresses():
    """Returns the files that do not state the project's address as Cargo.toml does."""
    address = re.search(r'^repository = "(.+)"', (ROOT / "Cargo.toml").read_text(), re.M).group(1)
    stated = {
        "Cargo.toml": [f'homepage = "{address}"'],
        "CITATION.cff": [f"url: {address}", f"repository-code: {address}"],
        "SECURITY.md": [f"{address}/security/advisories/new"],
        "plugins/python/pyproject.toml": [f'Homepage = "{address}"', f'Repository = "{address}"'],
        "plugins/python/conda/recipe.yaml": [f"homepage: {address}"],
        "ffi/package/spack/packages/entire/package.py": [f'homepage = "{address}"'],
        "ffi/package/vcpkg/vcpkg.json": [f'"homepage": "{address}"'],
    }
    stated |= {path: ["homepage.workspace = true"] for path in tracked("*/Cargo.toml")
               if "repository.workspace = true" in (ROOT / path).read_text()}  # fmt: skip
    return [name for name, texts in stated.items() if any(text not in (ROOT / name).read_text() for text in texts)]


def product_lines(folder):
    """Returns the number of lines of a crate's sources, without files of tests and the module of tests at a file's
    end."""
    count = 0
    for path in tracked(f"{folder}/src"):
        if path.endswith(".rs") and not path.endswith("tests.rs"):
            count += len((ROOT / path).read_text(encoding="utf-8").split("\n#[cfg(test)]\nmod tests {")[0].splitlines())
    return count


def public_items(crate):
    """Returns the number of a crate's public items outside of tests, without re-exports, fields and variants. Every
    `pub` item in a private module is reachable, since the workspace denies the lint `unreachable_pub`."""
    item = r'^[ \t]*pub (?:const |unsafe |async |extern "C" )*(?:fn|struct|enum|trait|const|type|static|mod|macro)\b[ \t]*\w'
    count = 0
    for path in (ROOT / crate / "src").rglob("*.rs"):
        if path.name != "tests.rs":
            text = path.read_text(encoding="utf-8").split("\n#[cfg(test)]\nmod tests {")[0]
            count += len(re.findall(item, text, re.M))
    return count


def build_seconds(revision, *arguments):
    """Returns the processor seconds and wall seconds of `cargo build` at a revision, with crates downloaded and nothing
    built."""
    with tempfile.TemporaryDirectory(prefix="house-") as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "worktree", "add", "--detach", "--quiet", tree, revision], cwd=ROOT, check=True)
        try:
            subprocess.run(["cargo", "fetch", "--locked", "--quiet"], cwd=tree, check=True)
            environment = {**os.environ, "CARGO_TARGET_DIR": str(Path(folder) / "target")}
            before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
            subprocess.run(["cargo", "build", "--locked", "--quiet", *arguments], cwd=tree, check=True, env=environment)
            after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - start
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def measure_builds(bars, before):
    entire = ("--release", "--package", "entire-cli", "--bin", "entire")
    (old, old_wall), (new, new_wall) = (build_seconds(revision, *entire) for revision in (before, "HEAD"))
    note = f"processor seconds: {new:.0f} / {old:.0f} at {before}; wall seconds: {new_wall:.0f} / {old_wall:.0f}"
    bars.found("release-build-over-earlier-build", new / old, note)
    core, wall = build_seconds("HEAD", "--package", "entire-core")
    bars.found("core-build-processor-s", core, f"wall seconds: {wall:.1f}")


# --------------------------------------------------------------------------------------------------------------- main


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave out what needs cargo or built programs")
    parser.add_argument("--bin-dir", type=Path, help="folder of `entire` and `entire-lab` (default target/release)")
    parser.add_argument("--measure-build", nargs="?", const=BEFORE, metavar="REVISION",
                        help=f"compare the builds of `entire` at this revision (default {BEFORE}) and at HEAD")
    options = parser.parse_args()
    with Bars(asked(options)) as bars:
        measure(bars, options)


def asked(options):
    """Limits of the bars by name."""
    counts = ["broken-links", "missing-paths", "missing-c-names", "missing-make-targets", "missing-examples",
              "documents-of-other-versions", "readme-figures-apart-from-results", "code-blocks-that-do-not-compile",
              "other-addresses", "circles-without-reason", "definitions-that-begin-with-what-whether-how"]
    if options.bin_dir or not options.quick:
        counts += ["missing-commands", "options-in-no-document"]
    if not options.quick:
        counts.append("study-crates-of-entire")
    out = dict.fromkeys(counts, 0) | {
        "readme-lines": README_LINES, "readme-first-embedding-code-line": FIRST_CODE_LINE, "longest-file": FILE_LINES,
        "circles-of-files": CIRCLES, "files-of-a-circle": CIRCLE_FILES,
    }
    if not options.quick:
        out |= {f"walk-files-of-{name}": files for name, files in WALKS.items()}
        out |= {f"public-items-of-{crate}": PUBLIC_ITEMS for crate in FRONT_CRATES}
        out |= {"lines-of-inference": INFERENCE_LINES, "crates-of-inference": INFERENCE_CRATES, "lines-of-rust": RUST_LINES}
        out |= {"release-build-over-earlier-build": ENTIRE_BUILD, "core-build-processor-s": CORE_BUILD_S}
    return out


def measure(bars, options):
    # The changelog mentions names that are removed.
    pages = [Page(path) for path in tracked("*.md") if path != "CHANGELOG.md"]
    readme = next(page for page in pages if page.path == "README.md")
    results = next(page for page in pages if page.path == "docs/src/results.md")
    front = [page for page in pages if page.path == "README.md" or page.path.startswith("docs/src/")]

    bars.found("readme-lines", len(readme.lines))
    first = min((number for number, language, _ in readme.blocks if language in EMBEDDING), default=len(readme.lines))
    bars.found("readme-first-embedding-code-line", first)
    for name, found in (
        ("broken-links", broken_links(pages)),
        ("missing-paths", missing_paths(front)),
        ("missing-c-names", missing_names(front)),
        ("missing-make-targets", missing_targets(pages)),
        ("missing-examples", missing_examples()),
        ("documents-of-other-versions", reach.stale()),
        ("readme-figures-apart-from-results", figures_apart_from_results(readme, results)),
    ):
        bars.count(name, sorted(set(found)))
    if shutil.which("cc"):
        bars.count("code-blocks-that-do-not-compile", sorted(set(broken_snippets(pages))))
    else:
        bars.lacking("there is no C compiler (apt-get install gcc)", ["code-blocks-that-do-not-compile"])
    bars.count("other-addresses", addresses())
    bars.count("definitions-that-begin-with-what-whether-how", list(clause_definitions()))
    lengths = sorted(file_lengths(), reverse=True)
    if not bars.found("longest-file", lengths[0][0]):
        print("\n".join(f"  {n} {path}" for n, path in lengths if n > FILE_LINES), flush=True)

    folder = options.bin_dir
    if folder or not options.quick:
        folder = (folder or ROOT / "target/release").resolve()
        absent = [name for name in ("entire", "entire-lab") if not (folder / name).exists()]
        if absent:
            raise SystemExit(f"house: {folder} has no {' and no '.join(absent)}; build them, or name their folder with --bin-dir")
        helps = Helps(folder)
        bars.count("missing-commands", sorted(set(missing_commands(pages, helps))))
        documents = [page for page in pages if page in front or page.path == "CONTRIBUTING.md"]
        bars.count("options-in-no-document", list(undocumented_options(documents, helps)))
    found = circles.all_circles()
    bars.count("circles-of-files", [" ".join(files) for files in found])
    bars.count("circles-without-reason", list(circles.differences(found)))
    if not bars.found("files-of-a-circle", max(map(len, found), default=0)):
        print("\n".join(f"  {' '.join(files)}" for files in found), flush=True)
    if options.quick:
        return
    for name, files in walks.all_walks().items():
        if not bars.found(f"walk-files-of-{name}", len(files)):
            print("\n".join(f"  {file}" for file in files), flush=True)
    for crate in FRONT_CRATES:
        bars.found(f"public-items-of-{crate}", public_items(crate))
    bars.found("lines-of-inference", product_lines("core"))
    linked = dependency_tree("entire-core", "normal,no-proc-macro", "--no-default-features")
    if not bars.found("crates-of-inference", len(linked)):
        print(f"  {' '.join(sorted(linked))}", flush=True)
    bars.found("lines-of-rust", sum(len((ROOT / path).read_bytes().splitlines()) for path in tracked("*.rs")))
    tree = dependency_tree("entire-cli", "normal,build")
    bars.count("study-crates-of-entire", [name for name in STUDY_CRATES if name in tree])
    if options.measure_build:
        measure_builds(bars, options.measure_build)
    else:
        bars.lacking("only on request: make bars-house HOUSE_BUILD=1", ["release-build-over-earlier-build", "core-build-processor-s"])


if __name__ == "__main__":
    main()
