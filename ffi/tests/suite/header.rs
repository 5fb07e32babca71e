//! `include/entire/entire.h` and `advanced.h` equal the headers that cbindgen makes from this crate's source.
//! `UPDATE_HEADER=1` (`make header`) writes them.

use entire_steer::control::{HybridOptions, StepLimits};
use std::collections::BTreeSet;
use std::path::Path;

/// Functions of `entire.h`: a render loop needs no others. All other functions are in `advanced.h`.
const RENDER_LOOP: [&str; 21] = [
    "entire_version",
    "entire_result_name",
    "entire_last_error",
    "entire_model_open",
    "entire_model_open_machine",
    "entire_model_free",
    "entire_volume_desc_init",
    "entire_volume_new",
    "entire_volume_free",
    "entire_transfer_function_from_nodes",
    "entire_transfer_function_from_table",
    "entire_transfer_function_free",
    "entire_frame_init",
    "entire_session_options_init",
    "entire_session_new",
    "entire_session_free",
    "entire_session_set_volume",
    "entire_session_set_transfer_function",
    "entire_session_set_limits",
    "entire_session_plan",
    "entire_session_observe",
];

/// The version macros, from the package's version.
fn version_macros() -> String {
    let part = |text: &str| text.parse::<u32>().expect("a version number");
    let (major, minor, patch) = (
        part(env!("CARGO_PKG_VERSION_MAJOR")),
        part(env!("CARGO_PKG_VERSION_MINOR")),
        part(env!("CARGO_PKG_VERSION_PATCH")),
    );
    let number = major * 1_000_000 + minor * 1000 + patch;
    let abi = if major == 0 { minor } else { major * 1000 };
    format!(
        "\n/* The version of this header; entire_version() and its siblings tell that of the library. */\n\
         #define ENTIRE_VERSION \"{}\"\n\
         #define ENTIRE_VERSION_MAJOR {major}\n\
         #define ENTIRE_VERSION_MINOR {minor}\n\
         #define ENTIRE_VERSION_PATCH {patch}\n\
         #define ENTIRE_VERSION_NUMBER {number}\n\
         #define ENTIRE_ABI_VERSION {abi}\n\n\
         /** Value of all three `strides` for voxels without gaps, in which x runs fastest, then y, then z. */\n\
         #define ENTIRE_STRIDE_CONTIGUOUS SIZE_MAX\n",
        env!("CARGO_PKG_VERSION")
    )
}

/// Header without the excluded items.
fn header(file: &str, after_includes: Option<String>, excluded: &BTreeSet<String>) -> String {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut config = cbindgen::Config::from_file(here.join("cbindgen.toml")).expect("ffi/cbindgen.toml");
    config.header = Some(std::fs::read_to_string(here.join(file)).expect(file));
    config.include_guard = Some(format!("ENTIRE_{}", file.replace('.', "_").to_ascii_uppercase()));
    if file != "entire.h" {
        config.sys_includes.clear();
        config.includes.push("entire.h".to_owned());
    }
    config.after_includes = after_includes;
    config.export.exclude.extend(excluded.iter().cloned());
    let bindings = cbindgen::Builder::new()
        .with_config(config)
        .with_crate(here)
        .generate()
        .expect("the C ABI of this crate");
    let mut text = Vec::new();
    bindings.write(&mut text);
    String::from_utf8(text).expect("a header in UTF-8")
}

/// Returns a header without its first comment, the conventions.
fn declarations(header: &str) -> &str {
    header.split_once("#ifndef").expect("an include guard").1
}

/// Names of the functions and types that a header declares.
fn declared(header: &str) -> (BTreeSet<String>, BTreeSet<String>) {
    let (mut functions, mut types) = (BTreeSet::new(), BTreeSet::new());
    for line in header.lines().filter(|l| !l.starts_with([' ', '/', '#', '*'])) {
        let name_before = |end: char| {
            line.split_once(end).and_then(|(before, _)| before.rsplit([' ', '*']).next()).map(str::to_owned)
        };
        if line.starts_with("typedef ") || line.starts_with('}') {
            types.extend(name_before(';'));
        } else {
            functions.extend(name_before('('));
        }
    }
    let ours = |names: BTreeSet<String>| names.into_iter().filter(|n| n.starts_with("entire_")).collect();
    (ours(functions), ours(types))
}

/// Names of the constants that a header defines.
fn constants(header: &str) -> impl Iterator<Item = &str> {
    header.lines().filter_map(|l| l.strip_prefix("#define ")?.split_once(' ')).map(|(name, _)| name)
}

/// Returns true if a text has the constant's name or that of its group, such as `ENTIRE_SCALAR_*`.
fn mentions(text: &str, constant: &str) -> bool {
    text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_' || c == '*')).any(|word| {
        word == constant
            || word.strip_suffix("_*").is_some_and(|group| constant.starts_with(&format!("{group}_")))
    })
}

/// The two headers. `entire.h` has the functions of a render loop. `advanced.h` includes `entire.h`; it has
/// the remaining functions, and the types and constants that `entire.h` does not use.
fn generate() -> [(&'static str, String); 2] {
    let all = header("entire.h", None, &BTreeSet::new());
    // cbindgen writes types only if a function uses them, but it writes all constants.
    let mut excluded = declared(&all).0;
    for function in RENDER_LOOP {
        assert!(excluded.remove(function), "the library has no function {function}");
    }
    let without_constants = excluded.iter().map(String::as_str).chain(constants(&all)).map(str::to_owned);
    let types = header("entire.h", None, &without_constants.collect());
    excluded.extend(constants(&all).filter(|c| !mentions(declarations(&types), c)).map(str::to_owned));
    let front = header("entire.h", Some(version_macros()), &excluded);
    let (functions, types) = declared(&front);
    excluded = functions.union(&types).cloned().chain(constants(&front).map(str::to_owned)).collect();
    [("advanced.h", header("advanced.h", None, &excluded)), ("entire.h", front)]
}

#[test]
fn the_committed_headers_are_those_of_the_source() {
    if Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml.orig").exists() {
        // A published package does not contain the headers.
        return;
    }
    for (name, generated) in generate() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../include/entire").join(name);
        if std::env::var_os("UPDATE_HEADER").is_some() {
            std::fs::create_dir_all(path.parent().expect("include/entire")).expect("include/entire");
            std::fs::write(&path, &generated).expect(name);
        }
        let committed = std::fs::read_to_string(&path).unwrap_or_default();
        let different = committed.lines().zip(generated.lines()).enumerate().find(|(_, (a, b))| a != b);
        if let Some((n, (a, b))) = different {
            panic!(
                "include/entire/{name} line {}: {a:?} is committed, the source gives {b:?}; run `make header`",
                n + 1
            );
        }
        assert_eq!(
            committed.len(),
            generated.len(),
            "include/entire/{name} is out of date; run `make header`"
        );
    }
}

#[test]
fn every_item_is_documented() {
    let headers = generate().map(|(_, text)| text).join("");
    let lines: Vec<&str> = headers.lines().collect();
    let mut undocumented = Vec::new();
    for (i, line) in lines.iter().enumerate().skip(1) {
        let field = line.strip_prefix("    ").is_some_and(|l| !l.starts_with(' ') && l.ends_with([';', ',']));
        let macro_with_value = line.starts_with("#define ENTIRE_") && line.split_whitespace().count() > 2;
        let function =
            !line.starts_with([' ', '/', '#', '*']) && line.contains('(') && line.contains(" entire_")
                || line.starts_with("const char *entire_");
        let structure = line.starts_with("typedef struct ");
        let before = lines[i - 1].trim_start();
        let documented = before.ends_with("*/") || before.starts_with("#define ENTIRE_VERSION");
        if (field || macro_with_value || function || structure) && !documented {
            undocumented.push(*line);
        }
    }
    assert!(undocumented.is_empty(), "without a comment in a header:\n{}", undocumented.join("\n"));
    assert!(lines.iter().filter(|l| l.contains(" entire_")).count() > 30);
}

/// The comment of a struct's field in the header.
fn comment_of<'a>(header: &'a str, structure: &str, field: &str) -> &'a str {
    let body = header.split(&format!("typedef struct {structure} {{")).nth(1).expect(structure);
    let body = body.split(&format!("}} {structure};")).next().expect(structure);
    let before = body.split(&format!(" {field};")).next().expect(field);
    before.rsplit("/**").next().expect(field)
}

#[test]
fn documented_defaults_are_those_of_the_code() {
    let [_, (_, header)] = generate();
    let (hybrid, steps) = (HybridOptions::default(), StepLimits::default());
    let defaults = [
        ("finest_step", steps.finest),
        ("coarsest_step", steps.coarsest),
        ("miss_rate", hybrid.miss_rate),
        ("tolerance", hybrid.tolerance),
        ("trust_limit", hybrid.trust_limit),
        ("damping", f32::from(u8::from(hybrid.damping))),
    ];
    for (field, value) in defaults {
        let comment = comment_of(&header, "entire_session_options", field).replace("\n     *", "");
        let words: Vec<&str> = comment.split_whitespace().collect();
        let text = words.join(" ");
        let stated =
            text.split("default ").nth(1).unwrap_or_else(|| panic!("{field} states no default: {text}"));
        let stated: String = stated.chars().take_while(|c| c.is_ascii_digit() || *c == '.').collect();
        let stated: f32 =
            stated.trim_end_matches('.').parse().unwrap_or_else(|e| panic!("{field}: {e}: {text}"));
        assert_eq!(stated, value, "entire_session_options.{field}: {text}");
    }
}
