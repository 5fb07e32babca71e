//! Compares node transfer functions with tables computed by VTK (`golden/vtk_transfer/make.py`).

use entire_core::scene::{Node, Nodes, TABLE_LEN, TransferFunction};
use serde_json::Value;

/// Upper bound of the difference between a color or opacity and VTK's value.
const TOLERANCE: f64 = 1e-6;

fn number(v: &Value) -> f64 {
    v.as_f64().expect("a number")
}

fn read_nodes<V>(nodes: &Value, value: impl Fn(&Value) -> V) -> Vec<Node<V>> {
    let node = |n: &Value| Node {
        position: number(&n[0]),
        value: value(&n[1]),
        midpoint: number(&n[2]),
        sharpness: number(&n[3]),
    };
    nodes.as_array().unwrap().iter().map(node).collect()
}

#[test]
fn tables_equal_those_of_vtk() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/vtk_transfer/values.json");
    let golden: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    let cases = golden["cases"].as_array().unwrap();
    assert!(cases.len() >= 12);
    let mut bent = 0;
    for (index, case) in cases.iter().enumerate() {
        let opacity = read_nodes(&case["opacity_nodes"], number);
        bent += opacity.iter().filter(|n| n.sharpness >= 0.01 && n.sharpness <= 0.99).count();
        let color = read_nodes(&case["color_nodes"], |color| [0, 1, 2].map(|c| number(&color[c])));
        let (low, high) = (number(&case["range"][0]), number(&case["range"][1]));
        let nodes = Nodes { opacity, color, range: (low, high), clamp: case["clamp"].as_bool().unwrap() };
        let table = TransferFunction::Nodes(nodes).to_table().unwrap();
        for i in 0..TABLE_LEN {
            let [r, g, b, a] = table.rgba()[i].map(f64::from);
            let wanted = number(&case["opacity"][i]);
            assert!((a - wanted).abs() <= TOLERANCE, "case {index}, opacity {i}: {a}, VTK has {wanted}");
            for (c, value) in [r, g, b].into_iter().enumerate() {
                let wanted = number(&case["color"][3 * i + c]);
                assert!(
                    (value - wanted).abs() <= TOLERANCE,
                    "case {index}, color {i}.{c}: {value}, VTK has {wanted}"
                );
            }
        }
    }
    assert!(bent > 10, "too few nodes of the golden cases take the curved branch");
}
