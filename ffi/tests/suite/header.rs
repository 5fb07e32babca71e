//! `include/entire/entire.h` equals the header that cbindgen makes from this crate's source.
//! `UPDATE_HEADER=1` (`make header`) writes it.

use entire_steer::control::{HybridOptions, StepLimits};
use std::path::{Path, PathBuf};

fn header_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../include/entire/entire.h")
}

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

fn generate() -> String {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut config = cbindgen::Config::from_file(here.join("cbindgen.toml")).expect("ffi/cbindgen.toml");
    config.header = Some(std::fs::read_to_string(here.join("header.h")).expect("ffi/header.h"));
    config.after_includes = Some(version_macros());
    let bindings = cbindgen::Builder::new()
        .with_config(config)
        .with_crate(here)
        .generate()
        .expect("the C ABI of this crate");
    let mut text = Vec::new();
    bindings.write(&mut text);
    String::from_utf8(text).expect("a header in UTF-8")
}

#[test]
fn the_committed_header_is_that_of_the_source() {
    if Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml.orig").exists() {
        // A published package lacks the repository, whose tests have checked the header.
        return;
    }
    let generated = generate();
    let path = header_path();
    if std::env::var_os("UPDATE_HEADER").is_some() {
        std::fs::create_dir_all(path.parent().expect("include/entire")).expect("include/entire");
        std::fs::write(&path, &generated).expect("include/entire/entire.h");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    if let Some((n, (a, b))) = committed.lines().zip(generated.lines()).enumerate().find(|(_, (a, b))| a != b)
    {
        panic!(
            "include/entire/entire.h line {}: {a:?} is committed, the source gives {b:?}; run `make header`",
            n + 1
        );
    }
    assert_eq!(committed.len(), generated.len(), "include/entire/entire.h is out of date; run `make header`");
}

#[test]
fn every_item_is_documented() {
    let header = generate();
    let lines: Vec<&str> = header.lines().collect();
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
    assert!(undocumented.is_empty(), "without a comment in entire.h:\n{}", undocumented.join("\n"));
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
    let header = generate();
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
