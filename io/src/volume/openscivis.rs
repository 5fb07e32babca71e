//! Raw voxels beside a JSON description, as in the Open SciVis data sets:
//!
//! `{"name": "…", "size": [x, y, z], "type": "uint8", "spacing": [x, y, z]}`
//!
//! Either file may be given. A `.json` finds its voxels by `"file"`, by the last part of `"url"`, or as the
//! `.raw` file of its own name. This name may be followed by size and type, as in `_256x256x256_uint8`. A
//! `.raw` finds the `.json` of its own name, with size and type or without them. A `.raw` file without a
//! description is read if its name states size and type.
//! `"endian"` (or `"byte_order"`) is `little` by default; `.raw.gz` is decompressed. Endings may be in upper
//! case.

use super::element::{expect_end, read_voxels};
use super::stream::{Companions, Stream};
use super::{Element, Endian, Parts, checked_dims, strip_ending, three_axes};
use crate::files::without_mark;
use anyhow::{Context, Result, anyhow, bail};
use serde_json::Value;

const MAX_JSON: u64 = 1 << 20;

struct Description {
    name: Option<String>,
    sizes: [u64; 3],
    spacing: [f64; 3],
    element: Element,
    endian: Endian,
    files: Vec<String>,
}

/// Reads the description from the stream, and the voxels from the file that belongs to the description.
pub(super) fn read_json(
    mut stream: Stream<'_>,
    file_name: &str,
    companions: &dyn Companions,
) -> Result<Parts> {
    let description = describe(&mut stream)?;
    let own = strip_ending(file_name, ".json").unwrap_or(file_name);
    let mut candidates = description.files.clone();
    candidates.extend([format!("{own}.raw"), own.to_owned(), format!("{own}.raw.gz")]);
    candidates.retain(|name| !name.is_empty() && name != file_name);
    let capitals = [".RAW", ".raw.GZ", ".RAW.GZ"].map(|ending| format!("{own}{ending}"));
    let mut found = candidates.iter().chain(&capitals).find(|name| companions.exists(name)).cloned();
    if found.is_none() {
        // <own>_256x256x256_uint8.raw
        let [x, y, z] = description.sizes;
        let start = format!("{own}_{x}x{y}x{z}");
        found = companions.ending_in(".raw").into_iter().find(|name| {
            // If a further digit or another type follows, the file belongs to another volume.
            let rest = name.strip_prefix(&start);
            let kind = strip_ending(name, ".raw").and_then(parse_name).map(|(.., kind)| kind);
            rest.is_some_and(|rest| !rest.starts_with(|c: char| c.is_ascii_digit()))
                && kind.is_none_or(|kind| kind == description.element)
        });
    }
    let Some(name) = found else {
        bail!(
            "no voxels beside the description: looked for {}; put the voxels' file there, or give its path, \
             relative to the description, under the key \"file\"",
            candidates.join(", ")
        );
    };
    let stream = companions.open(&name)?;
    voxels(stream, strip_ending(&name, ".gz").is_some(), description)
}

/// Reads the voxels from the stream. The description comes from a file beside the voxels' file, or from the
/// name of the voxels' file.
pub(super) fn read_raw(stream: Stream<'_>, file_name: &str, companions: &dyn Companions) -> Result<Parts> {
    let unpacked = strip_ending(file_name, ".gz");
    let packed = unpacked.is_some();
    let base = unpacked.unwrap_or(file_name);
    let own = strip_ending(base, ".raw").unwrap_or(base);
    let from_name = parse_name(own);
    let mut candidates = vec![format!("{own}.json"), format!("{base}.json")];
    if let Some((short, ..)) = from_name {
        candidates.push(format!("{short}.json"));
    }
    let capitals = format!("{own}.JSON");
    if let Some(name) = candidates.iter().chain([&capitals]).find(|name| companions.exists(name)) {
        let mut json = companions.open(name)?;
        let prefix = json.prefix();
        let description = describe(&mut json).with_context(|| prefix.trim_end_matches(": ").to_owned())?;
        return voxels(stream, packed, description);
    }
    let Some((name, sizes, element)) = from_name else {
        bail!(
            "raw voxels need a description beside them: looked for {}; write one like {{\"size\": [x, y, z], \
             \"type\": \"uint8\", \"spacing\": [1, 1, 1]}}",
            candidates.join(", ")
        );
    };
    let description = Description {
        name: Some(name.to_owned()),
        sizes,
        spacing: [1.0; 3],
        element,
        endian: Endian::Little,
        files: Vec::new(),
    };
    voxels(stream, packed, description)
}

fn voxels(mut stream: Stream<'_>, packed: bool, description: Description) -> Result<Parts> {
    let Description { name, sizes, spacing, element, endian, .. } = description;
    let dims = checked_dims(sizes)?;
    if packed {
        stream = stream.gunzip();
    }
    let data = read_voxels(&mut stream, dims, element, endian, None)?;
    let notes = expect_end(&mut stream, dims, element)?.into_iter().collect();
    Ok(Parts { data, dims, spacing, name, notes })
}

fn describe(stream: &mut Stream<'_>) -> Result<Description> {
    let bytes = stream.all(MAX_JSON)?;
    let json: Value = serde_json::from_slice(without_mark(&bytes))
        .map_err(|error| anyhow!("the description is not JSON: {error}"))?;
    let Value::Object(json) = json else {
        bail!("the description is not a JSON object with \"size\" and \"type\"");
    };
    let sizes: Vec<u64> = list(&json, &["size", "dimensions", "dims"], Value::as_u64)?
        .context("the description has no \"size\": [x, y, z]")?;
    let spacing: Vec<f64> =
        list(&json, &["spacing"], Value::as_f64)?.unwrap_or_else(|| vec![1.0; sizes.len()]);
    if spacing.len() != sizes.len() {
        bail!("\"spacing\" has {} entries, but \"size\" has {}", spacing.len(), sizes.len());
    }
    if let Some(components) = json.get("components").or_else(|| json.get("channels"))
        && components.as_u64() != Some(1)
    {
        bail!(
            "the description says {components} components per voxel, but only 1 is accepted; save one of them"
        );
    }
    let (sizes, spacing) = three_axes(&sizes, &spacing, &[])?;
    let text = |key: &str| json.get(key).and_then(Value::as_str);
    let kind = text("type").or_else(|| text("dtype")).context(
        "the description has no \"type\"; give the voxels' type, such as \"uint8\" or \"float32\"",
    )?;
    let Some(element) = element(kind) else {
        bail!(
            "type {kind:?} is not read; accepted are int8, uint8, int16, uint16, int32, uint32, int64, \
             uint64, float32, float64"
        );
    };
    let endian = match text("endian").or_else(|| text("byte_order")).map(str::to_ascii_lowercase).as_deref() {
        None | Some("little" | "littleendian" | "little-endian") => Endian::Little,
        Some("big" | "bigendian" | "big-endian") => Endian::Big,
        Some(other) => bail!("\"endian\" is {other:?}; accepted are little and big"),
    };
    let mut files: Vec<String> =
        ["file", "data", "data_file"].iter().filter_map(|key| text(key)).map(str::to_owned).collect();
    if let Some(url) = text("url") {
        files.push(url.rsplit('/').next().unwrap_or(url).to_owned());
    }
    Ok(Description { name: text("name").map(str::to_owned), sizes, spacing, element, endian, files })
}

fn list<T>(
    json: &serde_json::Map<String, Value>,
    keys: &[&str],
    number: impl Fn(&Value) -> Option<T>,
) -> Result<Option<Vec<T>>> {
    let Some((key, value)) = keys.iter().find_map(|key| Some((key, json.get(*key)?))) else {
        return Ok(None);
    };
    let numbers = value.as_array().and_then(|array| array.iter().map(number).collect::<Option<Vec<T>>>());
    numbers
        .map(Some)
        .with_context(|| format!("\"{key}\" is {value}; accepted is an array of numbers, x first"))
}

fn element(name: &str) -> Option<Element> {
    let types: [&[&str]; 10] = [
        &["int8", "i8", "char"],
        &["uint8", "u8", "uchar", "byte"],
        &["int16", "i16", "short"],
        &["uint16", "u16", "ushort"],
        &["int32", "i32", "int"],
        &["uint32", "u32", "uint"],
        &["int64", "i64"],
        &["uint64", "u64"],
        &["float32", "f32", "float"],
        &["float64", "f64", "double"],
    ];
    Element::named(types, &name.to_ascii_lowercase())
}

/// Parses names like `skull_256x256x256_uint8`.
fn parse_name(name: &str) -> Option<(&str, [u64; 3], Element)> {
    let (rest, kind) = name.rsplit_once('_')?;
    let (short, sizes) = rest.rsplit_once('_')?;
    let sizes: Vec<u64> = sizes.split(['x', 'X']).map(|n| n.parse().ok()).collect::<Option<_>>()?;
    Some((short, sizes.try_into().ok()?, element(kind)?))
}
