//! Compiles the ray-casting shader to SPIR-V, one module per mode, and writes a table of them for `include!`.

use naga::back::spv;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use std::fmt::Write as _;
use std::path::Path;
use std::{env, fs};

const SOURCE: &str = "src/vulkan/raycast.wgsl";

fn main() {
    println!("cargo::rerun-if-changed={SOURCE}");
    println!("cargo::rerun-if-changed=build.rs");
    let out = env::var("OUT_DIR").expect("cargo sets OUT_DIR");
    let source = fs::read_to_string(SOURCE).unwrap_or_else(|e| panic!("{SOURCE}: {e}"));
    let mut table = String::from("[\n");
    for shading in 0..4u32 {
        for skipping in 0..3u32 {
            for fetch in 0..3u32 {
                for [counting, packets, bricks] in [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1]] {
                    // Packets exist only for packed volumes (FETCH 2), and they change only the skipping.
                    if packets == 1 && (fetch != 2 || skipping == 0) {
                        continue;
                    }
                    // Shadow rays would leave the brick, and packed volumes are not cut into bricks.
                    if bricks == 1 && (fetch == 2 || shading >= 2) {
                        continue;
                    }
                    let constants = [
                        ("SHADING", shading),
                        ("LIT", shading % 2),
                        ("SCATTERS", shading / 2),
                        ("SKIPPING", skipping),
                        ("FETCH", fetch),
                        ("COUNTING", counting),
                        ("PACKETS", packets),
                        ("BRICKS", bricks),
                    ];
                    let words = compile(&specialize(&source, &constants));
                    let name = format!("raycast_{shading}{skipping}{fetch}{counting}{packets}{bricks}.spv");
                    let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
                    let path = Path::new(&out).join(&name);
                    fs::write(&path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
                    writeln!(
                        table,
                        "([{shading}, {skipping}, {fetch}, {counting}, {packets}, {bricks}], \
                         include_bytes!(concat!(env!(\"OUT_DIR\"), \"/{name}\")).as_slice()),"
                    )
                    .expect("writing to a string");
                }
            }
        }
    }
    table.push(']');
    fs::write(Path::new(&out).join("shaders.rs"), table).expect("OUT_DIR is writable");
}

/// Returns the source with only those lines that apply to the given constants. Understands `#if NAME == N`
/// (or `!=`), `#else` and `#endif`, also nested.
fn specialize(source: &str, constants: &[(&str, u32)]) -> String {
    let mut kept = String::new();
    let mut open: Vec<bool> = Vec::new();
    for (number, line) in source.lines().enumerate() {
        let fail = |why: &str| -> ! { panic!("{SOURCE}:{}: {why}: {line}", number + 1) };
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["#if", name, operator @ ("==" | "!="), value] => {
                let Some((_, found)) = constants.iter().find(|(n, _)| n == name) else {
                    fail("unknown constant")
                };
                let Ok(value) = value.parse::<u32>() else { fail("not a number") };
                open.push((*found == value) == (*operator == "=="));
            }
            ["#else"] => match open.last_mut() {
                Some(last) => *last = !*last,
                None => fail("no #if before"),
            },
            ["#endif"] => {
                if open.pop().is_none() {
                    fail("no #if before")
                }
            }
            [first, ..] if first.starts_with('#') => fail("unknown directive"),
            // Lines that are left out become blank, so that the compiler's line numbers are those of the
            // file.
            _ if open.contains(&false) => kept.push('\n'),
            _ => {
                kept.push_str(line);
                kept.push('\n');
                continue;
            }
        }
        if line.starts_with('#') {
            kept.push('\n');
        }
    }
    assert!(open.is_empty(), "{SOURCE}: #if without #endif");
    kept
}

/// Returns one module in SPIR-V 1.3, which Vulkan 1.1 accepts.
fn compile(source: &str) -> Vec<u32> {
    let module = naga::front::wgsl::parse_str(source)
        .unwrap_or_else(|e| panic!("{}", e.emit_to_string_with_path(source, SOURCE)));
    let info = Validator::new(ValidationFlags::all(), Capabilities::SUBGROUP)
        .validate(&module)
        .unwrap_or_else(|e| panic!("{}", e.emit_to_string_with_path(source, SOURCE)));
    let options = spv::Options {
        lang_version: (1, 3),
        flags: spv::WriterFlags::empty(),
        fake_missing_bindings: true,
        force_loop_bounding: false,
        emit_int_div_checks: false,
        ..Default::default()
    };
    let pipeline =
        spv::PipelineOptions { shader_stage: naga::ShaderStage::Compute, entry_point: "main".to_owned() };
    spv::write_vec(&module, &info, &options, Some(&pipeline)).unwrap_or_else(|e| panic!("{SOURCE}: {e}"))
}
