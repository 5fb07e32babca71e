//! `readers`: takes paths of volume files from standard input, one per line. Reads each file with the readers
//! of `entire`, and prints a line of JSON for it: `{"dims", "type", "spacing", "range", "crc32", "notes"}`,
//! `{"refused"}` or `{"panic"}`. `differential.py` runs this program.

use anyhow::Result;
use entire_io::volume;
use serde_json::{Value, json};
use std::io::{BufRead, Write};
use std::path::Path;
use volume::VolumeData;

/// Returns the line of JSON for a volume file. `cli/tests/suite/independent_readers.rs` compares the same
/// values with `right-values.csv`. `range` is the range of the finite voxels. `crc32` is the checksum of all
/// voxels in the type that they have in memory, little-endian; all NaNs count as the NaN without a payload.
fn line_of(path: &Path) -> Value {
    // Every value is read as stored, fill values included.
    let reading = volume::Reading { fill: volume::Fill::None, ..volume::Reading::default() };
    let volume = match volume::Volume::open_as(path, &reading, None) {
        Ok(volume) => volume,
        Err(error) => return json!({ "refused": format!("{error:#}") }),
    };
    let (kind, bytes): (_, Vec<u8>) = match volume.data() {
        VolumeData::U8(v) => ("uint8", v.clone()),
        VolumeData::U16(v) => ("uint16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::I16(v) => ("int16", v.iter().flat_map(|v| v.to_le_bytes()).collect()),
        VolumeData::F32(v) => {
            let one = |v: &f32| if v.is_nan() { f32::from_bits(0x7fc0_0000) } else { *v };
            ("float32", v.iter().flat_map(|v| one(v).to_le_bytes()).collect())
        }
    };
    let mut range = None;
    for value in volume.data().scalars().iter().filter(|v| v.is_finite()) {
        let (low, high) = range.unwrap_or((value, value));
        range = Some((value.min(low), value.max(high)));
    }
    json!({
        "dims": volume.dims(),
        "type": kind,
        "spacing": volume.spacing(),
        "range": range.map(|(low, high)| [low, high]),
        "crc32": format!("{:08x}", crc32fast::hash(&bytes)),
        "notes": volume.notes(),
    })
}

fn main() -> Result<()> {
    for line in std::io::stdin().lock().lines() {
        let path = line?;
        let found = std::panic::catch_unwind(|| line_of(Path::new(&path)));
        println!("{}", found.unwrap_or_else(|_| json!({ "panic": path })));
        std::io::stdout().flush()?;
    }
    Ok(())
}
