//! Checks rules that the compiler does not check: modules depend only on modules listed before them, and
//! `unsafe` is confined.

use proc_macro2::{TokenStream, TokenTree};
use quote::ToTokens;
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use syn::Item;
use syn::parse::{ParseStream, Parser};

/// Crates whose code is shipped.
const PRODUCTS: [&str; 11] = [
    "core",
    "steer",
    "ffi",
    "vk-raycaster",
    "explore",
    "io",
    "report",
    "train",
    "farm",
    "cli",
    "plugins/python",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace root").to_path_buf()
}

/// Returns the Rust files of a folder and of all folders below it; for a file, the file itself.
fn rust_files(place: &Path) -> Vec<PathBuf> {
    if place.is_file() {
        return vec![place.to_path_buf()];
    }
    let mut found = Vec::new();
    let mut stack = vec![place.to_path_buf()];
    while let Some(path) = stack.pop() {
        let entries = fs::read_dir(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        for entry in entries {
            let path = entry.expect("a directory entry").path();
            if path.is_dir() {
                stack.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    assert!(!found.is_empty(), "no Rust file under {}", place.display());
    found
}

/// True if an item has the attribute `#[cfg(test)]`.
fn for_tests(item: &impl ToTokens) -> bool {
    fn outer(input: ParseStream<'_>) -> syn::Result<Vec<syn::Attribute>> {
        let attributes = input.call(syn::Attribute::parse_outer)?;
        input.parse::<TokenStream>()?;
        Ok(attributes)
    }
    let attributes = outer.parse2(item.to_token_stream()).expect("attributes before an item");
    attributes.iter().any(|a| {
        a.path().is_ident("cfg") && a.parse_args::<syn::Ident>().is_ok_and(|condition| condition == "test")
    })
}

/// Removes the items with `#[cfg(test)]`, also inside modules, implementations and traits. Adds the names of
/// test-only modules that have files of their own to `test_modules`.
fn remove_tests(items: &mut Vec<Item>, test_modules: &mut BTreeSet<String>) {
    items.retain(|item| {
        let test = for_tests(item);
        if let Item::Mod(module) = item
            && test
            && module.content.is_none()
        {
            test_modules.insert(module.ident.to_string());
        }
        !test
    });
    for item in items {
        match item {
            Item::Mod(module) => {
                if let Some((_, items)) = &mut module.content {
                    remove_tests(items, test_modules);
                }
            }
            Item::Impl(item) => item.items.retain(|i| !for_tests(i)),
            Item::Trait(item) => item.items.retain(|i| !for_tests(i)),
            _ => {}
        }
    }
}

/// Returns the tokens of a text without test-only code, and the names of test-only modules.
fn product_tokens(text: &str) -> syn::Result<(TokenStream, BTreeSet<String>)> {
    let mut file = syn::parse_file(text)?;
    let mut test_modules = BTreeSet::new();
    remove_tests(&mut file.items, &mut test_modules);
    Ok((file.into_token_stream(), test_modules))
}

/// Returns the code of a folder or file, file by file, without test items and without files that are test
/// modules.
fn product(place: &Path) -> Vec<(PathBuf, TokenStream)> {
    let mut code = Vec::new();
    let mut tests: BTreeSet<PathBuf> = BTreeSet::new();
    for path in rust_files(place) {
        let text = fs::read_to_string(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let (tokens, modules) = product_tokens(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let folder = match path.file_name().and_then(|n| n.to_str()) {
            Some("mod.rs" | "lib.rs" | "main.rs") => path.parent().expect("a folder").to_path_buf(),
            _ => path.with_extension(""),
        };
        for module in modules {
            tests.insert(folder.join(format!("{module}.rs")));
            tests.insert(folder.join(module));
        }
        code.push((path, tokens));
    }
    code.retain(|(path, _)| !tests.iter().any(|test| path.starts_with(test)));
    code
}

/// Names that follow `root::` anywhere in the tokens, macros and grouped imports included.
fn names_below(root: &str, tokens: &TokenStream) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    collect_names(root, tokens.clone(), &mut found);
    found
}

fn collect_names(root: &str, tokens: TokenStream, found: &mut BTreeSet<String>) {
    let all: Vec<TokenTree> = tokens.into_iter().collect();
    let is_colon = |t: Option<&TokenTree>| matches!(t, Some(TokenTree::Punct(p)) if p.as_char() == ':');
    for (i, token) in all.iter().enumerate() {
        if let TokenTree::Group(group) = token {
            collect_names(root, group.stream(), found);
        }
        let here = matches!(token, TokenTree::Ident(ident) if ident == root);
        if !(here && is_colon(all.get(i + 1)) && is_colon(all.get(i + 2))) {
            continue;
        }
        match all.get(i + 3) {
            Some(TokenTree::Ident(name)) => {
                found.insert(name.to_string());
            }
            // `use root::{a, b::c}`: the first name of every branch.
            Some(TokenTree::Group(group)) => {
                let mut first = true;
                for t in group.stream() {
                    match t {
                        TokenTree::Ident(name) if first => {
                            found.insert(name.to_string());
                            first = false;
                        }
                        TokenTree::Punct(p) if p.as_char() == ',' => first = true,
                        _ => {}
                    }
                }
            }
            _ => {}
        }
    }
}

fn says(word: &str, tokens: TokenStream) -> bool {
    tokens.into_iter().any(|t| match t {
        TokenTree::Ident(ident) => ident == word,
        TokenTree::Group(group) => says(word, group.stream()),
        _ => false,
    })
}

/// Modules of a crate, with the other modules that each may use.
type Rooms = [(&'static str, &'static [&'static str])];

/// Modules of `core`. A module may also use itself.
const CORE: &Rooms = &[
    ("error", &[]),
    ("names", &[]),
    ("memory", &["error"]),
    ("scene", &["error", "memory", "names"]),
    ("kernels", &["error", "memory", "names"]),
    ("nn", &["error", "kernels", "memory", "names", "scene"]),
    ("model", &["error", "memory", "names", "nn"]),
];

const STEER: &Rooms = &[
    ("numeric", &[]),
    ("memory", &[]),
    ("features", &["memory"]),
    ("predict", &["features", "memory", "numeric"]),
    ("adapt", &["numeric", "predict"]),
    ("calibrate", &["features", "memory", "numeric", "predict"]),
    ("control", &["adapt", "calibrate", "features", "predict"]),
];

const IO: &Rooms = &[
    ("child", &[]),
    ("quiet", &[]),
    ("progress", &["quiet"]),
    ("files", &["quiet"]),
    ("volume", &["files"]),
    ("identity", &["files", "volume"]),
    ("interrupt", &["volume"]),
    ("machine", &[]),
    ("metrics", &[]),
    ("path", &["files"]),
    ("dataset", &["files", "identity", "metrics", "volume"]),
    ("options", &["dataset", "files", "machine", "volume"]),
    ("clock", &["dataset", "files", "options"]),
    ("scenes", &["dataset", "files"]),
];

const TRAIN: &Rooms = &[
    ("gradient", &[]),
    ("bound", &[]),
    ("split", &[]),
    ("teacher", &[]),
    ("inputs", &[]),
    ("evaluation", &["inputs"]),
    ("fit", &["gradient", "inputs"]),
];

/// Modules of `cli`: folders and files. Only `command_line` uses `commands`.
const CLI: &Rooms = &[
    ("pictures", &[]),
    ("program", &[]),
    ("reference", &[]),
    ("shipped", &[]),
    ("collection", &[]),
    ("calibrate", &["collection", "pictures"]),
    ("steering", &["calibrate", "pictures", "shipped"]),
    ("commands", &["calibrate", "collection", "pictures", "program", "shipped", "steering"]),
    ("command_line", &["commands", "program"]),
];

const LAB: &Rooms = &[
    ("bars", &[]),
    ("child", &[]),
    ("gpu", &["child"]),
    ("latency", &[]),
    ("stress", &["bars"]),
    ("trace", &[]),
    ("trees", &[]),
    ("fitted", &[]),
    ("farm", &["bars", "trace"]),
    ("replay", &["bars", "fitted", "trace"]),
    ("study", &["bars", "latency", "trees"]),
    ("ship", &["latency", "study"]),
    ("paper", &["bars", "child", "fitted", "latency", "replay", "study", "trace"]),
    (
        "commands",
        &["bars", "farm", "fitted", "gpu", "latency", "paper", "replay", "ship", "stress", "study", "trace"],
    ),
    ("command_line", &["commands"]),
];

/// Returns the modules in a crate's source folder: its folders, and its files except `lib.rs` and `main.rs`.
/// Test-only modules do not count.
fn rooms_of(source: &Path) -> Vec<String> {
    let text = fs::read_to_string(source.join("lib.rs")).expect("lib.rs");
    let (_, tests) = product_tokens(&text).expect("Rust");
    let mut found: Vec<String> = fs::read_dir(source)
        .expect("a source folder")
        .map(|entry| entry.expect("a directory entry").path())
        .filter_map(|path| path.file_stem()?.to_str().map(str::to_owned))
        .filter(|name| name != "lib" && name != "main" && !tests.contains(name))
        .collect();
    found.sort();
    found
}

/// Returns the uses of modules that the table does not allow.
fn arrows_that_point_back(source: &Path, rooms: &Rooms) -> Vec<String> {
    let mut wrong = Vec::new();
    for (room, allowed) in rooms {
        let folder = source.join(room);
        let place = if folder.is_dir() { folder } else { source.join(format!("{room}.rs")) };
        for (file, code) in product(&place) {
            for used in names_below("crate", &code) {
                let other = rooms.iter().any(|r| r.0 == used);
                if other && used != *room && !allowed.contains(&used.as_str()) {
                    wrong.push(format!("{} uses crate::{used}", file.display()));
                }
            }
        }
    }
    wrong
}

/// Returns the table's entries that allow a module to use a module that is not listed before it. Without such
/// entries, the table has no cycle.
fn rooms_in_a_circle(rooms: &Rooms) -> Vec<String> {
    let place = |room: &str| rooms.iter().position(|r| r.0 == room);
    rooms
        .iter()
        .enumerate()
        .flat_map(|(i, (room, allowed))| {
            allowed
                .iter()
                .filter(move |other| place(other).is_none_or(|at| at >= i))
                .map(move |other| format!("{room} may use {other}, which is not listed before it"))
        })
        .collect()
}

#[test]
fn arrows_between_the_rooms_of_a_crate_never_point_back() {
    let mut wrong = Vec::new();
    for (folder, rooms) in [
        ("core/src", CORE),
        ("steer/src", STEER),
        ("io/src", IO),
        ("train/src", TRAIN),
        ("cli/src", CLI),
        ("lab/src", LAB),
    ] {
        let source = root().join(folder);
        wrong.extend(arrows_that_point_back(&source, rooms));
        wrong.extend(rooms_in_a_circle(rooms));
        for room in rooms_of(&source) {
            if !rooms.iter().any(|r| r.0 == room) {
                wrong.push(format!("{folder}/{room} is a module that this test does not list"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Returns the lines of ARCHITECTURE.md about a folder: the line that begins with the folder's name, and the
/// indented lines after it.
fn section_of(map: &str, folder: &str) -> String {
    let start = format!("{folder}/ ");
    let after = |line: &&str| line.starts_with(' ');
    let mut lines = map.lines().skip_while(|line| !line.starts_with(&start));
    let first = lines.next().unwrap_or_else(|| panic!("ARCHITECTURE.md has no line {start}"));
    [first].into_iter().chain(lines.take_while(after)).collect::<Vec<_>>().join("\n")
}

/// Checks that ARCHITECTURE.md names each file and folder in the source folder of a crate.
#[test]
fn the_map_names_every_file_of_a_crates_top_level() {
    let map = fs::read_to_string(root().join("ARCHITECTURE.md")).expect("ARCHITECTURE.md");
    let mut missing = Vec::new();
    for folder in PRODUCTS.into_iter().filter(|p| !p.contains('/')).chain(["lab"]) {
        let section = section_of(&map, folder);
        let words: BTreeSet<&str> = section.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
        let rooms = rooms_of(&root().join(folder).join("src"));
        let unnamed =
            rooms.into_iter().filter(|room| !room.ends_with("_tests") && !words.contains(room.as_str()));
        missing.extend(unnamed.map(|room| format!("{folder}/src/{room}")));
    }
    assert!(missing.is_empty(), "ARCHITECTURE.md does not name\n{}", missing.join("\n"));
}

#[test]
fn the_product_knows_nothing_of_the_laboratory() {
    let root = root();
    for product in PRODUCTS {
        let manifest = fs::read_to_string(root.join(product).join("Cargo.toml")).expect("a manifest");
        for study in ["entire-lab", "forust"] {
            assert!(!manifest.contains(study), "{product}/Cargo.toml names {study}");
        }
    }
}

#[test]
fn the_raycaster_knows_nothing_of_prediction() {
    let mut wrong = Vec::new();
    for (file, code) in product(&root().join("vk-raycaster/src")) {
        for used in names_below("entire_core", &code) {
            if used != "scene" {
                wrong.push(format!("{} uses entire_core::{used}", file.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn unsafe_stays_behind_its_fences() {
    let root = root();
    let fences = [
        "core/src/kernels",
        "ffi/src",
        "vk-raycaster/src/vulkan",
        "explore/src/present",
        "plugins/python/src/lock.rs",
        "plugins/python/src/volume.rs",
    ];
    let mut wrong = Vec::new();
    for name in PRODUCTS.into_iter().chain(["lab"]) {
        for (file, code) in product(&root.join(name).join("src")) {
            let fenced = fences.iter().any(|fence| file.starts_with(root.join(fence)));
            if !fenced && says("unsafe", code) {
                wrong.push(file.display().to_string());
            }
        }
    }
    assert!(wrong.is_empty(), "unsafe outside of {fences:?}:\n{}", wrong.join("\n"));
}

/// Checks that [`product_tokens`] keeps the code after a test module and removes the code of tests, and that
/// [`names_below`] finds names in imports, paths and macros.
#[test]
fn the_rules_read_all_of_a_file_and_nothing_but_the_product() {
    let text = r#"
        #[cfg(test)]
        mod tests;
        #[cfg(test)]
        use crate::of_tests::Thing;
        use crate::{first, second::deep::Thing as Other};
        //! crate::in_a_comment
        mod inner {
            #[cfg(test)]
            mod tests { use crate::of_inner_tests; unsafe fn f() {} }
            fn g() { let text = "crate::in_a_string"; println!("{}", crate::in_a_macro::f()); }
        }
        impl A {
            #[cfg(test)]
            fn only_for_tests(&self) { crate::of_a_test_method::f() }
        }
        #[cfg(not(test))]
        fn h() { unsafe { crate::behind::f() } }
    "#
    .replace("//! crate::in_a_comment", "// crate::in_a_comment");
    let (tokens, modules) = product_tokens(&text).expect("Rust");
    assert_eq!(modules.into_iter().collect::<Vec<_>>(), ["tests"]);
    let names: Vec<String> = names_below("crate", &tokens).into_iter().collect();
    assert_eq!(names, ["behind", "first", "in_a_macro", "second"]);
    assert!(says("unsafe", tokens));
    let (tokens, _) = product_tokens("#[cfg(test)] mod t { unsafe fn f() {} } fn g() {}").expect("Rust");
    assert!(!says("unsafe", tokens));
}
