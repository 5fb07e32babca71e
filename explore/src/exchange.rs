//! Transfer functions in files: JSON of this program, and ParaView's color map presets.
//!
//! This program's format: one object, `format` is `"entire-transfer-1"`; `opacity` holds either
//! `{"points": [[scalar, opacity], …]}` or `{"lobes": [[center, width, height], …]}`; `colors` holds
//! `[[scalar, red, green, blue], …]`. Scalars are normalized, 0 to 1.
//!
//! ParaView's format: a preset, or an array of presets of which the first is read; `RGBPoints` holds (scalar,
//! red, green, blue) and `Points` (scalar, opacity, midpoint, sharpness) in the data's own scalars.

use crate::transfer::{Curve, Opacity};
use anyhow::{Context, Result, anyhow, bail, ensure};
use entire_core::GaussianLobe;
use entire_core::scene::{Node, Nodes, TransferFunction};
use entire_io::files::read_text;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::Path;

const FORMAT: &str = "entire-transfer-1";

/// Maximum size of a transfer function or script file, bytes.
pub(crate) const MOST_BYTES: u64 = 16 << 20;

/// Number of linear pieces that replace a curved segment between two of ParaView's nodes.
const SEGMENT_PIECES: usize = 16;

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: String,
    opacity: FileOpacity,
    colors: Vec<[f32; 4]>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum FileOpacity {
    Points(Vec<[f32; 2]>),
    Lobes(Vec<[f32; 3]>),
}

/// Reads a file of either format. `range`: the scalars that map to 0 and 1.
pub(crate) fn load(path: &Path, range: (f32, f32)) -> Result<Curve> {
    let text = read_text(path, MOST_BYTES).with_context(|| format!("cannot read {}", path.display()))?;
    parse(&text, range).with_context(|| format!("{} is no transfer function", path.display()))
}

fn parse(text: &str, range: (f32, f32)) -> Result<Curve> {
    let value: Value = serde_json::from_str(text)?;
    let curve = match &value {
        Value::Array(presets) => {
            let preset = presets.first().context("the array of presets is empty")?;
            from_paraview(preset, range)?
        }
        Value::Object(fields) if fields.contains_key("RGBPoints") => from_paraview(&value, range)?,
        _ => from_own(serde_json::from_value(value)?)?,
    };
    // Refuses curves of which no table can be made.
    curve.table()?;
    Ok(curve)
}

fn from_own(file: File) -> Result<Curve> {
    ensure!(file.format == FORMAT, "format is {:?}; this version reads {FORMAT:?}", file.format);
    let opacity = match file.opacity {
        FileOpacity::Points(points) => Opacity::Points(points),
        FileOpacity::Lobes(lobes) => Opacity::Lobes(
            lobes.into_iter().map(|[center, width, height]| GaussianLobe { center, width, height }).collect(),
        ),
    };
    ensure!(!file.colors.is_empty(), "there is no color; give at least one as [scalar, red, green, blue]");
    Ok(Curve { opacity, colors: file.colors.into_iter().map(|[s, r, g, b]| (s, [r, g, b])).collect() })
}

/// Returns the curve as this program's JSON.
pub(crate) fn to_own(curve: &Curve) -> Result<String> {
    let opacity = match &curve.opacity {
        Opacity::Points(points) => FileOpacity::Points(points.clone()),
        Opacity::Lobes(lobes) => {
            FileOpacity::Lobes(lobes.iter().map(|l| [l.center, l.width, l.height]).collect())
        }
    };
    let colors = curve.colors.iter().map(|&(s, [r, g, b])| [s, r, g, b]).collect();
    let file = File { format: FORMAT.into(), opacity, colors };
    Ok(serde_json::to_string_pretty(&file)? + "\n")
}

/// Returns the curve as a preset of ParaView, in which lobes become points. `range`: the scalars that map to
/// 0 and 1.
pub(crate) fn to_paraview(curve: &Curve, range: (f32, f32)) -> Result<String> {
    let scalar = |s: f32| f64::from(range.0) + f64::from(s) * (f64::from(range.1) - f64::from(range.0));
    let Opacity::Points(points) = curve.to_points().opacity else { bail!("lobes did not become points") };
    let opacity: Vec<f64> = points.iter().flat_map(|p| [scalar(p[0]), f64::from(p[1]), 0.5, 0.0]).collect();
    let colors: Vec<f64> = curve
        .colors
        .iter()
        .flat_map(|&(s, [r, g, b])| [scalar(s), f64::from(r), f64::from(g), f64::from(b)])
        .collect();
    let preset = json!([{"Name": "entire", "ColorSpace": "RGB", "RGBPoints": colors, "Points": opacity}]);
    Ok(serde_json::to_string_pretty(&preset)? + "\n")
}

fn numbers(value: &Value, key: &str) -> Result<Option<Vec<[f64; 4]>>> {
    let Some(list) = value.get(key) else { return Ok(None) };
    let list = list.as_array().with_context(|| format!("{key} is no array of numbers"))?;
    let all: Option<Vec<f64>> = list.iter().map(Value::as_f64).collect();
    let all = all.with_context(|| format!("{key} contains a value that is not a number"))?;
    ensure!(
        !all.is_empty() && all.len().is_multiple_of(4),
        "{key} has {} numbers; four for each node are expected",
        all.len()
    );
    Ok(Some(all.as_chunks::<4>().0.to_vec()))
}

fn from_paraview(preset: &Value, range: (f32, f32)) -> Result<Curve> {
    let colors = numbers(preset, "RGBPoints")?.ok_or_else(|| anyhow!("there are no RGBPoints"))?;
    // A preset without opacity becomes a ramp. Presets over the range 0 to 1 are stretched to the data's
    // range.
    let opacity = numbers(preset, "Points")?;
    let (low, high) = (f64::from(range.0), f64::from(range.1));
    let ends = |list: &[[f64; 4]]| (list[0][0], list[list.len() - 1][0]);
    let unit = ends(&colors) == (0.0, 1.0) && opacity.as_ref().is_none_or(|o| ends(o) == (0.0, 1.0));
    let (low, high) = if unit { (0.0, 1.0) } else { (low, high) };
    let normal = |x: f64| ((x - low) / (high - low).max(f64::MIN_POSITIVE)) as f32;
    let color_nodes: Vec<Node<[f64; 3]>> = colors
        .iter()
        .map(|c| Node { position: c[0], value: [c[1], c[2], c[3]], midpoint: 0.5, sharpness: 0.0 })
        .collect();
    let opacity_nodes: Vec<Node<f64>> = match &opacity {
        Some(list) => list
            .iter()
            .map(|p| Node { position: p[0], value: p[1], midpoint: p[2], sharpness: p[3] })
            .collect(),
        None => [(low, 0.0), (high, 0.2)]
            .map(|(position, opacity)| Node { position, value: opacity, midpoint: 0.5, sharpness: 0.0 })
            .to_vec(),
    };
    // The core checks the nodes and evaluates the curved segments.
    let table = TransferFunction::Nodes(Nodes {
        opacity: opacity_nodes.clone(),
        color: color_nodes,
        range: (low, high),
        clamp: true,
    })
    .to_table()?;
    let at = |s: f32| {
        let x = s.clamp(0.0, 1.0) * 255.0;
        let i = (x as usize).min(254);
        let (a, b) = (table.rgba()[i][3], table.rgba()[i + 1][3]);
        a + (x - i as f32) * (b - a)
    };
    let mut points: Vec<(f32, f32)> = Vec::new();
    for (i, node) in opacity_nodes.iter().enumerate() {
        let s = normal(node.position);
        points.push((s, node.value as f32));
        let bent = node.midpoint != 0.5 || node.sharpness != 0.0;
        if let (Some(next), true) = (opacity_nodes.get(i + 1), bent) {
            let (s, end) = (s.clamp(0.0, 1.0), normal(next.position).clamp(0.0, 1.0));
            for k in (1..SEGMENT_PIECES).filter(|_| s < end) {
                let s = s + (end - s) * k as f32 / SEGMENT_PIECES as f32;
                points.push((s, at(s)));
            }
        }
    }
    let colors = colors.iter().map(|c| (normal(c[0]), [c[1] as f32, c[2] as f32, c[3] as f32])).collect();
    let [first, .., last] = table.rgba();
    let points = within(points, [first[3], last[3]]);
    let colors = within(colors, [first, last].map(|&[r, g, b, _]| [r, g, b]));
    Ok(Curve { opacity: Opacity::Points(points.into_iter().map(|(s, a)| [s, a]).collect()), colors })
}

/// Returns the nodes (scalar, value) in [0, 1]. If nodes lie beyond an end of this range, the end gets a node
/// with its value in `ends`.
fn within<V: Copy>(nodes: Vec<(f32, V)>, ends: [V; 2]) -> Vec<(f32, V)> {
    let below = nodes.first().is_some_and(|n| n.0 < 0.0).then_some((0.0, ends[0]));
    let above = nodes.last().is_some_and(|n| n.0 > 1.0).then_some((1.0, ends[1]));
    let inside = nodes.into_iter().filter(|n| (0.0..=1.0).contains(&n.0));
    below.into_iter().chain(inside).chain(above).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::histogram::Histogram;
    use crate::transfer::PRESETS;

    /// Tolerance between the opacities of two curves that replace the same bent segment by linear pieces of
    /// different lengths.
    const BEND_ERROR: f32 = 0.01;

    #[test]
    fn both_kinds_of_file_come_back() {
        let histogram = Histogram { counts: vec![5; 256] };
        for name in PRESETS {
            let curve = Curve::preset(name, &histogram).unwrap();
            assert_eq!(parse(&to_own(&curve).unwrap(), (0.0, 1.0)).unwrap(), curve);
            let points = curve.to_points();
            let again = parse(&to_paraview(&points, (-50.0, 200.0)).unwrap(), (-50.0, 200.0)).unwrap();
            for i in 0..=50 {
                let s = i as f32 / 50.0;
                // Two points at one scalar make a step; a sample there may have either opacity.
                let step = name == "solid" && (s - histogram.quantile(0.5)).abs() < 0.01;
                assert!(step || (again.opacity_at(s) - points.opacity_at(s)).abs() < 1e-4, "{name} at {s}");
                let (a, b) = (again.color_at(s), points.color_at(s));
                assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1e-4), "{name} at {s}");
            }
        }
    }

    #[test]
    fn a_preset_of_paraview_is_read_with_its_bends() {
        let text = r#"[{"ColorSpace": "RGB", "Name": "x", "RGBPoints": [10, 1, 0, 0, 30, 0, 0, 1],
            "Points": [10, 0, 0.5, 0, 20, 0.5, 0.5, 1, 30, 1, 0.5, 0]}]"#;
        let curve = parse(text, (10.0, 30.0)).unwrap();
        assert!((curve.opacity_at(0.25) - 0.25).abs() < 1e-3);
        // With sharpness 1, the segment is nearly a step at its middle.
        assert!(curve.opacity_at(0.65) < 0.55 && curve.opacity_at(0.85) > 0.95);
        assert_eq!(curve.color_at(0.5), [0.5, 0.0, 0.5]);
    }

    #[test]
    fn nodes_outside_of_the_range_keep_the_function() {
        let text = r#"[{"ColorSpace": "RGB", "Name": "x", "RGBPoints": [0, 1, 0, 0, 100, 0, 0, 1],
            "Points": [0, 0, 0.5, 0, 60, 0.6, 0.5, 0, 100, 1, 0.5, 0]}]"#;
        let curve = parse(text, (25.0, 75.0)).unwrap();
        for s in [0.0, 0.2, 0.7, 1.0] {
            let value = 0.25 + 0.5 * s;
            assert!((curve.opacity_at(s) - value).abs() < 1e-6, "{s}: {}", curve.opacity_at(s));
            let [r, g, b] = curve.color_at(s);
            assert!(
                (r - 1.0 + value).abs() < 1e-6 && g == 0.0 && (b - value).abs() < 1e-6,
                "{s}: {r} {g} {b}"
            );
        }
        // Only a part of the bent segment lies in the range.
        let bent = text.replace("[0, 0, 0.5, 0,", "[0, 0, 0.5, 0.5,");
        let (whole, part) = (parse(&bent, (0.0, 100.0)).unwrap(), parse(&bent, (15.0, 40.0)).unwrap());
        for s in [0.0, 0.3, 0.8, 1.0] {
            let (a, b) = (part.opacity_at(s), whole.opacity_at(0.15 + 0.25 * s));
            assert!((a - b).abs() < BEND_ERROR, "{s}: {a} {b}");
        }
        let beyond = parse(text, (200.0, 300.0)).unwrap();
        assert_eq!([0.0, 0.5, 1.0].map(|s| beyond.opacity_at(s)), [1.0; 3]);
    }

    #[test]
    #[cfg(unix)]
    fn only_regular_files_are_read() {
        let endless = load(Path::new("/dev/zero"), (0.0, 1.0)).unwrap_err();
        assert!(format!("{endless:#}").contains("not a regular file"), "{endless:#}");
    }

    #[test]
    fn what_is_wrong_is_said() {
        for (text, says) in [
            ("[]", "empty"),
            ("{\"format\": \"x\", \"opacity\": {\"points\": []}, \"colors\": []}", "format"),
            ("[{\"RGBPoints\": [1, 2, 3]}]", "four for each node"),
            ("[{\"RGBPoints\": [0, 2, 0, 0, 1, 0, 0, 0]}]", "color node"),
            ("nonsense", "expected"),
        ] {
            let e = format!("{:#}", parse(text, (0.0, 1.0)).unwrap_err());
            assert!(e.contains(says), "{text}: {e}");
        }
    }
}
