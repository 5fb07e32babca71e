//! Tables of compared pictures: one CSV row per picture with its scene, its settings, its time, and its error
//! against the picture of the same scene at full quality.

use super::groups::Groups;
use super::table::{positions, unreadable};
use crate::files::read_decompressed;
use anyhow::{Context, Result, anyhow, ensure};
use entire_steer::calibrate::Picture;
use std::path::Path;

/// The columns, in any order: a name of the view; the ray step as a multiple of the finest one; pixels
/// between neighboring rays along each side; seconds by any clock; the error, 0 for a picture that equals the
/// full-quality picture.
const PICTURE_COLUMNS: [&str; 5] = ["scene", "step", "image_sample_distance", "seconds", "error"];

/// Reads a table of compared pictures. A file whose name ends in `.gz` is decompressed.
///
/// # Errors
/// When the file cannot be read, a column is missing, or a row holds an invalid value; the message names
/// file, line and column.
pub fn read_pictures(path: &Path) -> Result<Vec<Picture>> {
    let bytes = read_decompressed(path).with_context(|| format!("cannot read {}", path.display()))?;
    parse_pictures(&bytes).with_context(|| format!("{} is no table of compared pictures", path.display()))
}

fn parse_pictures(bytes: &[u8]) -> Result<Vec<Picture>> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(bytes);
    let columns = positions(reader.headers()?, PICTURE_COLUMNS).map_err(|name| {
        anyhow!("its first line names no column {name}; needed are {}", PICTURE_COLUMNS.join(", "))
    })?;
    let mut scenes = Groups::default();
    let mut out = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| unreadable(&e))?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |i: usize| -> Result<f64> {
            let text = record.get(columns[i]).unwrap_or("");
            text.parse()
                .with_context(|| format!("line {line}, column {}: {text:?} is no number", PICTURE_COLUMNS[i]))
        };
        let picture = Picture {
            scene: scenes.number(record.get(columns[0]).unwrap_or("")),
            step: number(1)? as f32,
            distance: number(2)? as f32,
            seconds: number(3)?,
            error: number(4)?,
        };
        picture.check().with_context(|| format!("line {line}"))?;
        out.push(picture);
    }
    ensure!(!out.is_empty(), "the table holds no pictures");
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_read_by_their_columns_names() {
        let text = "error,scene, step,image_sample_distance,seconds,note\n0,a,1,1,0.5,x\n2.5,b,2,1.2,0.25,y\n1,a,2,1,0.3,z\n";
        let pictures = parse_pictures(text.as_bytes()).unwrap();
        let picture =
            |scene, step, distance, seconds, error| Picture { scene, step, distance, seconds, error };
        assert_eq!(
            pictures,
            [picture(0, 1.0, 1.0, 0.5, 0.0), picture(1, 2.0, 1.2, 0.25, 2.5), picture(0, 2.0, 1.0, 0.3, 1.0)]
        );
    }

    #[test]
    fn what_is_wrong_is_named() {
        let says = |text: &str| format!("{:#}", parse_pictures(text.as_bytes()).unwrap_err());
        assert!(says("scene,step,seconds,error\n").contains("no column image_sample_distance"));
        let head = PICTURE_COLUMNS.join(",");
        assert!(says(&head).contains("no pictures"));
        let text = says(&format!("{head}\na,1,1,0.5,0\na,2,1,fast,1\n"));
        assert!(text.contains("line 3, column seconds: \"fast\""), "{text}");
        let text = says(&format!("{head}\na,0.5,1,0.5,0\n"));
        assert!(text.contains("line 2") && text.contains("step 0.5"), "{text}");
    }
}
