//! Transfer functions given as nodes with midpoint and sharpness: the representation of VTK and ParaView
//! (`vtkPiecewiseFunction` for opacity, `vtkColorTransferFunction` in RGB for color), evaluated as VTK does.
//!
//! Between two nodes, the left node's midpoint is the position at which the value is half way between the two
//! nodes' values. The left node's sharpness selects the curve. With a sharpness below 0.01, the curve is
//! linear on both sides of the midpoint. With a larger sharpness, the position is first moved away from the
//! midpoint, towards the nearer node, by the power 1 + 10·sharpness; the value at the moved position follows
//! a cubic Hermite curve whose end slopes are (1 − sharpness) times the rise. With a sharpness above 0.99,
//! colors change in one step at the midpoint; opacity follows the curve, as in VTK's two classes. Every table
//! entry agrees with VTK 9.7 within 1e-6.

use super::transfer::{TABLE_LEN, TransferTable, ramp};
use crate::Result;
use crate::error::bail;
use alloc::vec::Vec;

/// A node of an opacity function (`V` is `f64`) or of a color function (`V` is `[f64; 3]`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Node<V> {
    /// Scalar value, in the unit of the function's range.
    pub position: f64,
    /// Opacity over one unit distance ([`TransferTable::unit_distance`]), or red, green, blue; in [0, 1].
    pub value: V,
    /// Position at which the value is half way between the values of this node and the next, in [0, 1]: 0 at
    /// this node, 1 at the next.
    pub midpoint: f64,
    /// Steepness of the change, in [0, 1]: 0 linear, 1 nearly a step. With a sharpness above 0.99, a color
    /// changes in one step at the midpoint; opacity follows the curve.
    pub sharpness: f64,
}

/// Opacity and color nodes with the scalar range that maps to [0, 1].
///
/// [`TransferFunction::to_table`](super::TransferFunction::to_table) refuses nodes that are not in ascending
/// order or have values out of range, and names the node. Two nodes at one position make a step. Without
/// opacity nodes everything is transparent; without color nodes the colors are those of Gaussian transfer
/// functions.
#[derive(Clone, Debug, PartialEq)]
pub struct Nodes {
    /// The opacity nodes, in ascending position.
    pub opacity: Vec<Node<f64>>,
    /// The color nodes, in ascending position.
    pub color: Vec<Node<[f64; 3]>>,
    /// The scalar range that maps to [0, 1], normally the volume's: both ends finite, the low end at most the
    /// high one.
    pub range: (f64, f64),
    /// True if the values of the outermost nodes also hold beyond them (VTK's default). If false, positions
    /// beyond them are transparent and black.
    pub clamp: bool,
}

impl Nodes {
    fn check(&self) -> Result<()> {
        let (low, high) = self.range;
        if !(low.is_finite() && high.is_finite() && low <= high) {
            bail!(
                InvalidArgument,
                "transfer function range is {low}…{high}; both ends must be finite and the low end not above the high one"
            );
        }
        check_nodes("opacity", &self.opacity, |opacity| [opacity; 3])?;
        check_nodes("color", &self.color, |color| color)
    }

    pub(super) fn to_table(&self) -> Result<TransferTable> {
        self.check()?;
        let (low, high) = self.range;
        let (mut next_opacity, mut next_color) = (0, 0);
        let mut rgba = [[0.0; 4]; TABLE_LEN];
        for (i, entry) in rgba.iter_mut().enumerate() {
            let t = i as f64 / (TABLE_LEN - 1) as f64;
            // x is a weighted mean of the ends, so that the width of f64::MIN…f64::MAX does not overflow. It
            // is exact at both ends.
            let x = if i + 1 == TABLE_LEN { high } else { low * (1.0 - t) + high * t };
            next_opacity += self.opacity[next_opacity..].iter().take_while(|n| x > n.position).count();
            next_color += self.color[next_color..].iter().take_while(|n| x > n.position).count();

            let [alpha, ..] = evaluate(&self.opacity, next_opacity, x, self.clamp, false, |a| [a; 3]);
            let [r, g, b] = if self.color.is_empty() {
                ramp(t as f32)
            } else {
                evaluate(&self.color, next_color, x, self.clamp, true, |color| color).map(|v| v as f32)
            };
            *entry = [r, g, b, alpha as f32];
        }
        TransferTable::new(rgba)
    }
}

fn check_nodes<V: Copy>(what: &str, nodes: &[Node<V>], channels: impl Fn(V) -> [f64; 3]) -> Result<()> {
    let unit = 0.0..=1.0;
    let mut previous = f64::NEG_INFINITY;
    for (i, &Node { position, value, midpoint, sharpness }) in nodes.iter().enumerate() {
        let value = channels(value);
        if !position.is_finite() {
            bail!(InvalidArgument, "{what} node {i}: position is {position}; it must be finite");
        }
        if position < previous {
            bail!(
                InvalidArgument,
                "{what} node {i} at {position} lies before its predecessor at {previous}; sort the nodes by position"
            );
        }
        previous = position;
        if value.iter().any(|v| !unit.contains(v)) {
            bail!(InvalidArgument, "{what} node {i}: value is {value:?}; it must lie in [0, 1]");
        }
        if !unit.contains(&midpoint) || !unit.contains(&sharpness) {
            bail!(
                InvalidArgument,
                "{what} node {i}: midpoint is {midpoint} and sharpness {sharpness}; both must lie in [0, 1] (0.5 and 0 when unknown)"
            );
        }
    }
    Ok(())
}

/// Value of the function at `x`; `next` is the index of the first node at or after `x`. If `steps` is
/// true, a sharpness above 0.99 means one step at the midpoint.
fn evaluate<V: Copy>(
    nodes: &[Node<V>],
    next: usize,
    x: f64,
    clamp: bool,
    steps: bool,
    channels: impl Fn(V) -> [f64; 3],
) -> [f64; 3] {
    let (Some(first), Some(last)) = (nodes.first(), nodes.last()) else { return [0.0; 3] };
    if next == 0 || next >= nodes.len() {
        let outside = if next == 0 { first } else { last };
        return if clamp { channels(outside.value) } else { [0.0; 3] };
    }
    let (left, right) = (&nodes[next - 1], &nodes[next]);
    let (x0, x1) = (left.position, right.position);
    let (midpoint, sharpness) = (left.midpoint, left.sharpness);
    let (from, to) = (channels(left.value), channels(right.value));

    // All terms are halved, so that the distance between the largest floats stays finite. The midpoint is
    // clamped away from the ends, which avoids a division by zero.
    let s = (0.5 * x - 0.5 * x0) / (0.5 * x1 - 0.5 * x0);
    let m = midpoint.clamp(1e-5, 1.0 - 1e-5);
    let s = if s < m { 0.5 * s / m } else { 0.5 + 0.5 * (s - m) / (1.0 - m) };
    if steps && sharpness > 0.99 {
        return if s < 0.5 { from } else { to };
    }
    let mut out = [0.0; 3];
    if sharpness < 0.01 {
        for ((o, a), b) in out.iter_mut().zip(from).zip(to) {
            *o = ((1.0 - s) * a + s * b).clamp(a.min(b), a.max(b));
        }
        return out;
    }
    let bend = 1.0 + 10.0 * sharpness;
    let s =
        if s < 0.5 { 0.5 * libm::pow(2.0 * s, bend) } else { 1.0 - 0.5 * libm::pow(2.0 * (1.0 - s), bend) };
    let (s2, s3) = (s * s, s * s * s);
    let (h_from, h_to) = (2.0 * s3 - 3.0 * s2 + 1.0, 3.0 * s2 - 2.0 * s3);
    // Sum of the Hermite weights of both end slopes, which are equal.
    let h_slope = 2.0 * s3 - 3.0 * s2 + s;
    for ((o, a), b) in out.iter_mut().zip(from).zip(to) {
        let slope = (1.0 - sharpness) * (b - a);
        *o = (h_from * a + h_to * b + h_slope * slope).clamp(a.min(b), a.max(b));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::TransferFunction;
    use super::*;
    use alloc::vec;

    fn node(position: f64, value: f64, midpoint: f64, sharpness: f64) -> Node<f64> {
        Node { position, value, midpoint, sharpness }
    }

    fn table(
        opacity: Vec<Node<f64>>,
        color: Vec<Node<[f64; 3]>>,
        low: f64,
        high: f64,
    ) -> Result<TransferTable> {
        TransferFunction::Nodes(Nodes { opacity, color, range: (low, high), clamp: true }).to_table()
    }

    fn opacities(nodes: Vec<Node<f64>>, low: f64, high: f64) -> Vec<f32> {
        table(nodes, vec![], low, high).unwrap().rgba().iter().map(|e| e[3]).collect()
    }

    #[test]
    fn no_node_is_transparent_and_one_node_is_constant() {
        assert!(opacities(vec![], 0.0, 1.0).iter().all(|&a| a == 0.0));
        assert!(opacities(vec![node(5.0, 0.25, 0.5, 0.0)], 0.0, 1.0).iter().all(|&a| a == 0.25));
    }

    #[test]
    fn without_colors_the_ramp_is_used() {
        let table = table(vec![node(0.0, 0.5, 0.5, 0.0)], vec![], 0.0, 1.0).unwrap();
        assert_eq!(table.rgba()[0][..3], super::super::transfer::COLOR_RAMP[0].1);
        assert_eq!(table.rgba()[255][..3], super::super::transfer::COLOR_RAMP[5].1);
    }

    #[test]
    fn the_largest_range_stays_finite() {
        let t =
            opacities(vec![node(f64::MIN, 0.0, 0.5, 0.0), node(f64::MAX, 1.0, 0.5, 0.0)], f64::MIN, f64::MAX);
        for (i, a) in t.iter().enumerate() {
            assert!((a - i as f32 / 255.0).abs() < 1e-6, "{i} {a}");
        }
    }

    #[test]
    fn a_range_of_zero_width_samples_one_value() {
        let t = opacities(vec![node(0.0, 0.0, 0.5, 0.0), node(2.0, 1.0, 0.5, 0.0)], 1.0, 1.0);
        assert!(t.iter().all(|&a| a == 0.5));
    }

    #[test]
    fn bad_nodes_are_refused_by_name() {
        let refuse = |nodes: Vec<Node<f64>>, words: &str| {
            let e = table(nodes, vec![], 0.0, 1.0).unwrap_err();
            assert_eq!(e.kind(), crate::ErrorKind::InvalidArgument);
            assert!(e.to_string().contains(words), "{e}");
        };
        refuse(vec![node(f64::NAN, 0.1, 0.5, 0.0)], "opacity node 0: position");
        refuse(vec![node(1.0, 0.1, 0.5, 0.0), node(0.5, 0.1, 0.5, 0.0)], "opacity node 1 at 0.5 lies before");
        refuse(vec![node(0.0, 1.5, 0.5, 0.0)], "opacity node 0: value");
        refuse(vec![node(0.0, f64::NAN, 0.5, 0.0)], "opacity node 0: value");
        refuse(vec![node(0.0, 0.5, -0.1, 0.0)], "midpoint");
        refuse(vec![node(0.0, 0.5, 0.5, f64::NAN)], "sharpness");
        let color = Node { position: 0.0, value: [0.0, 2.0, 0.0], midpoint: 0.5, sharpness: 0.0 };
        assert!(
            table(vec![], vec![color], 0.0, 1.0).unwrap_err().to_string().contains("color node 0: value")
        );
        assert!(table(vec![], vec![], 1.0, 0.0).is_err());
        assert!(table(vec![], vec![], f64::NAN, 0.0).is_err());
    }
}
