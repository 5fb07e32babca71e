//! Lines and areas cut off at the frame. The drawing library itself moves points outside of the frame to its
//! edge, which bends lines and the edges of areas.

use super::axis::Span;

type Point = (f64, f64);

/// Returns the parts of a line inside both ranges. The line is broken at points that a scale cannot place,
/// such as 0 on a logarithmic axis.
pub(super) fn clip(points: &[Point], x: &Span, y: &Span) -> Vec<Vec<Point>> {
    let mut parts: Vec<Vec<Point>> = Vec::new();
    for run in points.split(|p| !x.takes(p.0) || !y.takes(p.1)) {
        // True if the last part ends where the next segment begins.
        let mut open = false;
        for pair in run.windows(2) {
            let Some((start, end, whole)) = segment(pair[0], pair[1], x, y) else {
                open = false;
                continue;
            };
            match parts.last_mut() {
                Some(part) if open => part.push(end),
                _ => parts.push(vec![start, end]),
            }
            open = whole;
        }
    }
    parts
}

/// Returns the part of a segment inside both ranges, and true if this part reaches the segment's end; `None`
/// if no part is inside (Liang and Barsky).
fn segment(a: Point, b: Point, x: &Span, y: &Span) -> Option<(Point, Point, bool)> {
    let from = (x.place(a.0), y.place(a.1));
    let by = (x.place(b.0) - from.0, y.place(b.1) - from.1);
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for (from, by) in [(from.0, by.0), (from.1, by.1)] {
        if by == 0.0 {
            if !(0.0..=1.0).contains(&from) {
                return None;
            }
            continue;
        }
        let (low, high) = (-from / by, (1.0 - from) / by);
        enter = enter.max(low.min(high));
        leave = leave.min(low.max(high));
    }
    if enter > leave {
        return None;
    }
    let at = |t: f64| (x.value(from.0 + t * by.0), y.value(from.1 + t * by.1));
    let start = if enter > 0.0 { at(enter) } else { a };
    let end = if leave < 1.0 { at(leave) } else { b };
    Some((start, end, leave >= 1.0))
}

/// Returns the corners of the part of an area inside both ranges (Sutherland and Hodgman). Corners that a
/// scale cannot place are left out.
pub(super) fn clip_area(corners: impl Iterator<Item = Point>, x: &Span, y: &Span) -> Vec<Point> {
    let corners: Vec<Point> = corners.filter(|p| x.takes(p.0) && y.takes(p.1)).collect();
    if corners.iter().all(|p| x.shows(p.0) && y.shows(p.1)) {
        return corners;
    }
    let mut area: Vec<[f64; 2]> = corners.iter().map(|p| [x.place(p.0), y.place(p.1)]).collect();
    for (axis, limit, sign) in [(0, 0.0, 1.0), (0, 1.0, -1.0), (1, 0.0, 1.0), (1, 1.0, -1.0)] {
        let depth = |p: [f64; 2]| sign * (p[axis] - limit);
        let mut inside = Vec::new();
        for (i, &b) in area.iter().enumerate() {
            let a = area[if i == 0 { area.len() - 1 } else { i - 1 }];
            let (from, to) = (depth(a), depth(b));
            if (from < 0.0) != (to < 0.0) {
                let t = from / (from - to);
                inside.push([0, 1].map(|k| a[k] + t * (b[k] - a[k])));
            }
            if to >= 0.0 {
                inside.push(b);
            }
        }
        area = inside;
    }
    area.into_iter().map(|[px, py]| (x.value(px), y.value(py))).collect()
}

#[cfg(test)]
mod tests {
    use super::super::Axis;
    use super::*;

    fn unit() -> Span {
        Span::fit(&Axis::linear("").from(0.0).to(1.0), std::iter::empty())
    }

    #[test]
    fn lines_are_cut_where_they_meet_the_frame() {
        let line = [(-1.0, 0.5), (0.5, 0.5), (0.5, 3.0), (0.75, 3.0), (0.75, 0.25)];
        let parts = clip(&line, &unit(), &unit());
        assert_eq!(parts, [vec![(0.0, 0.5), (0.5, 0.5), (0.5, 1.0)], vec![(0.75, 1.0), (0.75, 0.25)]]);
        // A diagonal whose ends are outside the ranges.
        assert_eq!(clip(&[(-1.0, -1.0), (2.0, 2.0)], &unit(), &unit()), [vec![(0.0, 0.0), (1.0, 1.0)]]);
        assert!(clip(&[(-1.0, 0.5), (0.5, 3.0)], &unit(), &unit()).is_empty());
    }

    #[test]
    fn areas_are_cut_where_their_edges_meet_the_frame() {
        let cut = |corners: &[Point]| clip_area(corners.iter().copied(), &unit(), &unit());
        // A triangle whose tip is above the frame.
        let found = cut(&[(0.0, 0.0), (0.5, 2.0), (1.0, 0.0)]);
        assert_eq!(found, [(0.0, 0.0), (0.25, 1.0), (0.75, 1.0), (1.0, 0.0)]);
        assert!(cut(&[(0.0, 2.0), (0.5, 3.0), (1.0, 2.0)]).is_empty());
        let inside = [(0.0, 0.1), (0.3, 0.7), (1.0, 0.2)];
        assert_eq!(cut(&inside), inside);
    }

    #[test]
    fn values_without_a_place_break_lines() {
        let line = [(0.1, 0.1), (0.2, 0.2), (0.3, f64::NAN), (0.4, 0.4), (0.5, 0.5), (f64::INFINITY, 0.5)];
        let parts = clip(&line, &unit(), &unit());
        assert_eq!(parts, [vec![(0.1, 0.1), (0.2, 0.2)], vec![(0.4, 0.4), (0.5, 0.5)]]);
    }

    #[test]
    fn on_a_logarithmic_axis_lines_are_straight_in_the_logarithm() {
        let y = Span::fit(&Axis::log("").from(1.0).to(100.0), std::iter::empty());
        let parts = clip(&[(0.0, 0.1), (1.0, 1000.0)], &unit(), &y);
        let [(x0, y0), (x1, y1)] = parts[0][..] else { panic!("{parts:?}") };
        for (found, expected) in [(x0, 0.25), (y0, 1.0), (x1, 0.75), (y1, 100.0)] {
            assert!((found - expected).abs() < 1e-9 * expected, "{parts:?}");
        }
    }
}
