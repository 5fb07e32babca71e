#!/usr/bin/env python3
# SPDX-License-Identifier: MIT OR Apache-2.0
"""Counts the files that a reader visits to follow one value (a frame, or a command's options) through the source.

    walks.py [WALK ...]     prints the files of each walk, one a line, in the order of the visits

A walk begins in a function, with one of its parameters: the value. The reader visits each first-party function, of any
crate, to which a visited function passes the value, a part of it (a field, also borrowed or cloned), or a structure or
tuple of such parts; and each first-party method that is called on one of these. In the visited function, the walk goes on
with the parameters that received the value or parts of it. Results of other calls are other values and are not followed.
The length of a walk is its number of distinct files. A call through a trait leads to the trait's declaration. A method
whose receiver has no visible type is followed if only one type has a method of this name, and otherwise left out.
"""
import re
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CRATES = ("core", "steer", "io", "train", "report", "farm", "ffi", "vk-raycaster", "explore", "cli", "lab")
# Each walk: file, function, the followed parameter.
WALKS = {
    "plan": ("steer/src/control/session.rs", "plan", "frame"),
    "calibrate": ("cli/src/commands/calibrate.rs", "run", "options"),
    "steer": ("cli/src/commands/steer.rs", "run", "options"),
    "train": ("cli/src/commands/train.rs", "run", "options"),
}
# Methods that return the receiver, a part of it, or a copy.
PARTS = set("""as_ref as_mut as_deref as_slice as_path as_str as_bytes iter iter_mut into_iter clone cloned copied to_owned
to_vec to_string into unwrap_or unwrap_or_default borrow zip chain enumerate checked first last get""".split())
OPERATORS = ("==", "!=", "<", ">", "<=", ">=", "+", "-", "/")
TOKEN = re.compile(
    r"""//[^\n]*|/\*.*?\*/"""  # comments
    r"""|b?r(#*)".*?"\1|b?"(?:\\.|[^"\\])*"|b?'(?:\\.[^']*|[^'\\])'"""  # texts and characters
    r"""|'\w+|\w+|::|->|=>|\.\.=?|&&|\|\||[<>=!]=|\s+|.""",
    re.S,
)
TEXT = ('"', 'b"', 'r"', 'r#')
# Words before a round bracket that are no functions.
NO_CALL = ("if", "match", "while", "for", "in", "return", "let", "Some", "Ok", "Err", "move")
CLOSE = {"(": ")", "[": "]", "{": "}"}
WORD = re.compile(r"[A-Za-z_]\w*$")


def tokens_of(text):
    found = (m[0] for m in TOKEN.finditer(text) if not m[0].isspace() and not m[0].startswith(("//", "/*")))
    return ['""' if token.startswith(TEXT) else token for token in found]


def closing(tokens, at):
    """Returns the index of the bracket that closes the one at index `at`."""
    depth = 0
    for i in range(at, len(tokens)):
        depth += (tokens[i] in CLOSE) - (tokens[i] in CLOSE.values())
        if depth == 0:
            return i
    return len(tokens) - 1


def angle(tokens, at):
    """Returns the index behind the angle brackets that begin at index `at`; `at` if none begin there."""
    if at >= len(tokens) or tokens[at] != "<":
        return at
    depth = 0
    for i in range(at, len(tokens)):
        depth += (tokens[i] == "<") - (tokens[i] == ">")
        if depth == 0:
            return i + 1
    return at


def split(tokens):
    """Returns the parts of a list of tokens between commas outside of brackets, and outside of a closure's parameters."""
    parts, depth, bars = [[]], 0, False
    for i, token in enumerate(tokens):
        if token == "|" and depth == 0:
            bars = not bars if bars or not parts[-1] or parts[-1][-1] in ("move", "&", "mut") else bars
        depth += (token in CLOSE or token == "<") - (token in CLOSE.values() or token == ">")
        if token == "," and depth == 0 and not bars:
            parts.append([])
        else:
            parts[-1].append(token)
    return [part for part in parts if part]


def head(kind):
    """Returns the name of a type's outermost first-party candidate: references, `Option`, `Box` and slices are left out."""
    names = [t for i, t in enumerate(kind) if WORD.match(t) and t[0].isupper()]
    for name in names:
        if name not in ("Option", "Box", "Arc", "Rc", "Vec", "Result", "Self"):
            return name
    return "Self" if "Self" in names else None


class Function:
    def __init__(self, file, name, owner, parameters, body):
        self.file, self.name, self.owner, self.body = file, name, owner, body
        self.receiver = bool(parameters) and "self" in parameters[0][:4] and ":" not in parameters[0]
        self.parameters = [("self", [owner or ""])] if self.receiver else []
        for parameter in parameters[self.receiver:]:
            at = parameter.index(":") if ":" in parameter else len(parameter)
            names = [t for t in parameter[:at] if WORD.match(t) and t not in ("mut", "ref") and t[0].islower()]
            self.parameters.append((names[0] if names else "_", parameter[at + 1:]))


class Source:
    """Functions, fields and imports of the crates' sources, without tests."""

    def __init__(self, root):
        self.functions, self.fields, self.imports = [], {}, {}
        self.methods, self.free = defaultdict(list), defaultdict(list)
        for crate in CRATES:
            for path in sorted((root / crate / "src").rglob("*.rs")):
                if not path.stem.endswith("tests") and "tests" not in path.relative_to(root).parts[2:-1]:
                    self.read(str(path.relative_to(root)), path.read_text(encoding="utf-8"))
        for function in self.functions:
            (self.methods if function.owner else self.free)[function.name].append(function)

    def read(self, file, text):
        tokens = tokens_of(text.split("\n#[cfg(test)]\nmod tests {")[0])
        self.imports[file] = {name: path for path, name in imported(tokens)}
        self.items(file, tokens, None)

    def items(self, file, tokens, owner):
        i = 0
        while i < len(tokens):
            token = tokens[i]
            if token == "fn" and i + 1 < len(tokens) and WORD.match(tokens[i + 1]):
                at = angle(tokens, i + 2)
                if at >= len(tokens) or tokens[at] != "(":
                    i += 1
                    continue
                end = closing(tokens, at)
                body = end
                while body < len(tokens) and tokens[body] not in ("{", ";"):
                    body = closing(tokens, body) + 1 if tokens[body] in CLOSE and body > end else body + 1
                stop = closing(tokens, body) if body < len(tokens) and tokens[body] == "{" else body
                self.functions.append(Function(file, tokens[i + 1], owner, split(tokens[at + 1:end]), tokens[body + 1:stop]))
                self.items(file, tokens[body + 1:stop], None)
                i = stop
            elif token in ("impl", "trait") and (i == 0 or tokens[i - 1] in ("}", ";", "]", "{", "pub", ")", "unsafe")):
                at = i + 1
                while at < len(tokens) and tokens[at] not in ("{", ";"):
                    at = closing(tokens, at) + 1 if tokens[at] in ("(", "[") else at + 1
                before = tokens[angle(tokens, i + 1):at]
                before = before[:before.index("where")] if "where" in before else before
                name = before[before.index("for") + 1:] if "for" in before else before
                name = name[:1] if token == "trait" else name
                name = name[:name.index("<")] if "<" in name else name
                plain = [t for t in name if WORD.match(t) and t not in ("dyn", "mut")]
                stop = closing(tokens, at) if at < len(tokens) and tokens[at] == "{" else at
                self.items(file, tokens[at + 1:stop], plain[-1] if plain else None)
                i = stop
            elif token in ("struct", "enum") and i + 1 < len(tokens):
                at = i + 2
                while at < len(tokens) and tokens[at] not in ("{", "(", ";"):
                    at += 1
                if at < len(tokens) and tokens[at] == "{":
                    stop = closing(tokens, at)
                    for part in split(tokens[at + 1:stop]):
                        while part[:1] == ["#"]:
                            part = part[closing(part, 1) + 1:]
                        if ":" in part:
                            self.fields[(tokens[i + 1], part[part.index(":") - 1])] = head(part[part.index(":") + 1:])
                    i = stop
            i += 1


def imported(tokens):
    """Yields (module path, name) of each `use`."""
    def branch(at, before):
        while tokens[at] not in (";", ",", "}"):
            if tokens[at] == "{":
                at += 1
                while tokens[at] != "}":
                    at = yield from branch(at, before)
                    at += tokens[at] == ","
                return at + 1
            if tokens[at] == "as":
                yield before, tokens[at + 1]
                return at + 2
            before = before if tokens[at] in ("::", "self") else (*before, tokens[at])
            at += 1
        if before and tokens[at - 1] != "}":
            yield before, before[-1]
        return at
    for i, token in enumerate(tokens):
        if token == "use" and i + 1 < len(tokens):
            yield from branch(i + 1, ())


def module(file):
    """Returns the path of the module in a file, as other crates name it: io/src/dataset/mod.rs is entire_io, dataset."""
    crate, _, rest = file.partition("/src/")
    parts = [part for part in rest[:-3].split("/") if part not in ("lib", "main", "mod")]
    return ["entire_" + crate.replace("-", "_"), *parts]


class Walk:
    def __init__(self, source, file, name, parameter):
        self.source, self.files, self.seen = source, [], set()
        start = [f for f in source.functions if (f.file, f.name) == (file, name) and parameter in dict(f.parameters)]
        if not start:
            raise SystemExit(f"walks: {file} has no function {name} with a parameter {parameter}")
        self.visit(start[0], {parameter: None})

    def visit(self, function, tracked):
        """`tracked` maps the parameters that receive the value to the fields that hold it; None stands for all fields."""
        key = (id(function), frozenset(tracked.items()))
        if key in self.seen:
            return
        self.seen.add(key)
        if function.file not in self.files:
            self.files.append(function.file)
        self.function, types = function, {}
        for name, kind in function.parameters:
            types[name] = head(kind) if head(kind) != "Self" else function.owner
        for callee, parameters in self.calls(function, dict(tracked), types):
            self.visit(callee, parameters)

    def calls(self, function, tracked, types):
        """Returns the functions to which a function passes the tracked names, with the parameters that receive them."""
        found, body = [], function.body
        for i, token in enumerate(body):
            if token == "let":
                self.bind(body, i, tracked, types, function)
            elif token == "for" and "in" in body[i:i + 12]:
                at = body.index("in", i)
                passed, fields = self.passes(body[at + 1:body.index("{", at)], tracked)
                for name in names_in(body[i + 1:at]):
                    tracked.pop(name, None)
                    if passed:
                        tracked[name] = fields
            if token != "(" or i == 0:
                continue
            name_at = i - 1
            if body[name_at] == ">":
                while name_at > 0 and body[name_at] != "::":
                    name_at -= 1
                name_at -= 1
            name = body[name_at]
            if not WORD.match(name) or name in NO_CALL:
                continue
            arguments = split(body[i + 1:closing(body, i)])
            method = name_at > 0 and body[name_at - 1] == "."
            start = name_at
            if method:
                start = receiver_start(body, name_at - 1)
                receiver = body[start:name_at - 1]
                on_value, own_fields = self.passes(receiver, tracked)
            else:
                while start > 1 and body[start - 1] == "::":
                    start -= 2
                receiver, on_value, own_fields = [], False, None
            passed = {}
            for n, argument in enumerate(arguments):
                is_value, fields = self.passes(argument, tracked)
                if is_value:
                    passed[n] = fields
            if not passed and not on_value:
                continue
            path = [t for t in body[start:name_at] if WORD.match(t)] if not method else []
            for callee in self.resolve(function, name, path, receiver if method else None, types, len(arguments)):
                own = [p for p, _ in callee.parameters]
                shift = 1 if method and callee.receiver else 0
                received = {own[n + shift]: fields for n, fields in passed.items() if n + shift < len(own)}
                if on_value and callee.receiver:
                    received["self"] = own_fields
                if received or on_value:
                    found.append((callee, received))
        return found

    def bind(self, body, at, tracked, types, function):
        """Adds the names that a `let` binds to the value, a part of it, or a structure of such parts."""
        end = at + 1
        while end < len(body) and body[end] not in ("=", ";"):
            end = closing(body, end) + 1 if body[end] in CLOSE else end + 1
        if end >= len(body) or body[end] != "=":
            return
        stop = end + 1
        while stop < len(body) and body[stop] not in (";", "else"):
            stop = closing(body, stop) + 1 if body[stop] in CLOSE else stop + 1
        pattern, value = body[at + 1:end], body[end + 1:stop]
        declared = pattern.index(":") if ":" in pattern and "{" not in pattern else len(pattern)
        names = names_in(pattern[:declared])
        kind = head(pattern[declared + 1:])
        if not kind:
            plain = [t for t in value if t not in ("&", "mut", "*")]
            if plain and plain[0][0].isupper():
                at_type = 0
                while at_type + 2 < len(plain) and plain[at_type + 1] == "::" and plain[at_type + 2][0].isupper():
                    at_type += 2
                kind = plain[at_type]
            else:
                kind = self.type_of(value, types)
        for name in names:
            types[name] = kind
        parts, values = elements(pattern[:declared]), elements(value)
        pairs = zip(parts, values) if parts and len(parts) == len(values) else [(pattern[:declared], value)]
        # The arms of a branch, and the results of a closure, are other values.
        found = {name: self.passes(to, tracked) for part, to in pairs for name in names_in(part)
                 if to[0] not in ("match", "if") and "|" not in to and "||" not in to}
        for name in names:
            tracked.pop(name, None)
            if found.get(name, (False,))[0]:
                tracked[name] = found[name][1]

    def passes(self, value, tracked):
        """Returns (True, its fields) if an expression is the value, a part of it, or a structure or tuple that contains a
        part; (False, None) otherwise. The fields are those of a structure that hold such parts, or None for all."""
        plain = [t for t in value if t not in ("&", "mut", "*")]
        at = 0
        while at + 2 < len(plain) and plain[at + 1] == "::":
            at += 2
        if len(plain) > at + 2 and plain[at][0].isupper() and plain[at + 1] == "{" and closing(plain, at + 1) == len(plain) - 1:
            fields = set()
            for part in split(plain[at + 2:-1]):
                if part[0] == "..":
                    passed, base = self.passes(part[1:], tracked)
                    if passed:
                        fields = None if base is None else fields | base
                elif self.passes(part[part.index(":") + 1:] if ":" in part[:2] else part, tracked)[0] and fields is not None:
                    fields.add(part[0])
            return (False, None) if fields == set() else (True, fields and frozenset(fields))
        i = 0
        while i < len(value):
            token = value[i]
            before = value[i - 1] if i else ""
            if token in tracked and before not in (".", "::") and not (i + 1 < len(value) and value[i + 1] in ("::", ":", "!")):
                fields, at = tracked[token], i + 1
                holds = True
                while at < len(value):
                    if value[at] == "." and at + 1 < len(value):
                        if at + 2 < len(value) and value[at + 2] == "(":
                            if value[at + 1] not in PARTS:
                                break
                            at = closing(value, at + 2) + 1
                        else:
                            holds &= fields is None or value[at + 1] in fields
                            fields, at = None, at + 2
                    elif value[at] == "[":
                        at = closing(value, at) + 1
                    elif value[at] == "?":
                        at += 1
                    else:
                        break
                ended = at >= len(value) or value[at] not in (".", *OPERATORS)
                if holds and ended and before not in OPERATORS:
                    return True, fields if i <= 2 and at >= len(value) else None
                i = at
                continue
            if token == "(" and before not in NO_CALL and (WORD.match(before) or before in (">", "!")):
                i = closing(value, i)
            i += 1
        return False, None

    def type_of(self, receiver, types):
        """Returns the type of a chain of fields, if it is visible; None otherwise."""
        chain = [t for t in receiver if t not in ("&", "mut", "*", "?")]
        if not chain or chain[0] not in types and chain[0] != "self":
            return None
        kind = types.get(chain[0]) or (self.function.owner if chain[0] == "self" else None)
        i = 1
        while i + 1 < len(chain) and chain[i] == ".":
            if i + 2 < len(chain) and chain[i + 2] == "(":
                if chain[i + 1] not in PARTS | {"unwrap", "expect", "context", "filter"}:
                    return None
                i = closing(chain, i + 2) + 1
            else:
                kind = self.source.fields.get((kind, chain[i + 1]))
                i += 2
        return kind if i >= len(chain) else None

    def resolve(self, function, name, path, receiver, types, arguments):
        """Returns the first-party functions that a call with a number of arguments means: one, or none."""
        source = self.source
        if receiver is not None:
            kind = self.type_of(receiver, types)
            candidates = [f for f in source.methods[name] if f.receiver and len(f.parameters) == arguments + 1]
            if kind:
                exact = [f for f in candidates if f.owner == kind]
                return self.nearest(function, exact)
            if name in PARTS or name in STANDARD or len({(f.owner, f.file) for f in candidates}) != 1:
                return []
            return candidates[:1]
        if path and (path[-1][0].isupper()):
            kind = function.owner if path[-1] == "Self" else path[-1]
            exact = [f for f in source.methods[name] if f.owner == kind]
            return self.nearest(function, exact, source.imports[function.file].get(kind, ()))
        candidates = source.free[name]
        if not path:
            mine = [f for f in candidates if f.file == function.file]
            if mine:
                return mine[:1]
            whole = source.imports[function.file].get(name)
            return self.nearest(function, candidates, whole) if whole else []
        whole = (*source.imports[function.file].get(path[0], (path[0],)), *path[1:], name)
        return self.nearest(function, candidates, whole)

    def nearest(self, function, candidates, path=()):
        """Returns the candidate whose file fits an imported path best: the longest common end of the modules, then the same
        crate; none for a path into a foreign crate."""
        crate = module(function.file)[0]
        if path and path[0] not in ("crate", "super", "self") and not path[0].startswith("entire_"):
            local = [f for f in candidates if path[0] in module(f.file) and module(f.file)[0] == crate]
            candidates = local
        def fit(f):
            where = module(f.file)
            first = path[0] if path else ""
            home = where[0] == (first if first.startswith("entire_") else crate)
            return (home, len(set(where[1:]) & set(path[:-1])), f.file == function.file)
        return sorted(candidates, key=fit, reverse=True)[:1]


# Methods of the standard library that first-party types have, too.
STANDARD = set("""len map and_then ok_or_else filter collect push insert extend contains contains_key is_empty is_some is_none
is_some_and is_none_or ok err context with_context unwrap expect min max abs write read flush take replace finish
parse join exists display file_name parent with_extension extension lock send recv wait fold all any find position
sort sort_by to_lowercase trim lines split starts_with ends_with transpose map_or map_or_else unwrap_or_else then keys
values entry remove clear retain next rev sum product min_by max_by total_cmp start end set name eq cmp fmt from new
default""".split())


def elements(tokens):
    """Returns the elements of a tuple or of its pattern; an empty list for anything else."""
    tokens = tokens[1:] if tokens[:1] in (["&"], ["mut"]) else tokens
    for start in (["("], ["Some", "("], ["Ok", "("]):
        if tokens[:len(start)] == start and closing(tokens, len(start) - 1) == len(tokens) - 1:
            return split(tokens[len(start):-1])
    return []


def names_in(pattern):
    return {t for i, t in enumerate(pattern) if WORD.match(t) and t[0].islower() and t not in ("mut", "ref", "box", "if", "let")
            and not (i + 1 < len(pattern) and pattern[i + 1] in ("::", ":"))}


def receiver_start(body, dot):
    """Returns the index at which the expression before a dot begins."""
    at = dot - 1
    while at >= 0:
        if body[at] in (")", "]"):
            depth = 0
            while at >= 0:
                depth += (body[at] in (")", "]", "}")) - (body[at] in CLOSE)
                if depth == 0:
                    break
                at -= 1
            if at > 0 and (WORD.match(body[at - 1])):
                at -= 1
        elif body[at] == "?":
            at -= 1
            continue
        if at > 0 and body[at - 1] in (".", "::"):
            at -= 2
            continue
        return max(at, 0)
    return 0


# A small source whose walk is known: from a.rs to b.rs, which gets a structure with a part of the value, to d.rs, which gets
# this part, and to f.rs, which defines the type of a field. The walk does not lead to c.rs, which gets the result of a call,
# nor to e.rs, which gets a field of the structure that holds no part.
KNOWN = {
    "a.rs": """use crate::f::Other;
        pub struct Options { pub size: usize, pub other: Other }
        pub fn run(options: &Options) {
            let settings = Settings { size: options.size, fixed: 1 };
            crate::b::draw(&settings);
            crate::c::draw(own(options.size));
            options.other.check();
        }
        fn own(size: usize) -> usize { size + 1 }""",
    "b.rs": "pub fn draw(settings: &Settings) { crate::d::draw(settings.size); crate::e::draw(settings.fixed); }",
    "c.rs": "pub fn draw(size: usize) {}",
    "d.rs": "pub fn draw(size: usize) {}",
    "e.rs": "pub fn draw(fixed: usize) {}",
    "f.rs": "pub struct Other; impl Other { pub fn check(&self) {} }",
}


def check():
    """Ends the program if the walk of the known source is wrong."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "core/src"
        place.mkdir(parents=True)
        for name, text in KNOWN.items():
            (place / name).write_text(text, encoding="utf-8")
        files = Walk(Source(Path(folder)), "core/src/a.rs", "run", "options").files
    if files != [f"core/src/{name}.rs" for name in "abdf"]:
        raise SystemExit(f"walks: the walk of the known source is {files}")


def all_walks():
    """Returns the files of each walk in WALKS, in the order of the visits."""
    check()
    source = Source(ROOT)
    return {name: Walk(source, *walk).files for name, walk in WALKS.items()}


if __name__ == "__main__":
    for walk, files in all_walks().items():
        if walk in (sys.argv[1:] or WALKS):
            print(f"{walk}: {len(files)} files", *files, sep="\n  ")
