//! Placement of the texts of points, each beside its point, clear of others, inside the frame.

/// A rectangle in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) right: f64,
    pub(super) bottom: f64,
}

impl Rect {
    /// Returns the square around a point whose sides are twice `half` long.
    pub(super) fn around(x: f64, y: f64, half: f64) -> Self {
        Self { left: x - half, top: y - half, right: x + half, bottom: y + half }
    }

    /// Returns squares along a line between two points, at most 8 pixels apart and each 2 pixels wide.
    pub(super) fn along(a: (f64, f64), b: (f64, f64)) -> impl Iterator<Item = Self> {
        let (dx, dy) = (b.0 - a.0, b.1 - a.1);
        let parts = (dx.hypot(dy) / 8.0).ceil().clamp(1.0, 1000.0) as usize;
        (0..=parts).map(move |i| {
            let share = i as f64 / parts as f64;
            Self::around(a.0 + share * dx, a.1 + share * dy, 1.0)
        })
    }

    fn holds(&self, other: &Self) -> bool {
        other.left >= self.left
            && other.right <= self.right
            && other.top >= self.top
            && other.bottom <= self.bottom
    }

    fn area(&self) -> f64 {
        (self.right - self.left).max(0.0) * (self.bottom - self.top).max(0.0)
    }

    /// Returns the area of the intersection with another rectangle.
    fn shared(&self, other: &Self) -> f64 {
        let left = self.left.max(other.left);
        let top = self.top.max(other.top);
        Self { left, top, right: self.right.min(other.right), bottom: self.bottom.min(other.bottom) }.area()
    }

    fn meets(&self, other: &Self) -> bool {
        self.left <= other.right
            && self.right >= other.left
            && self.top <= other.bottom
            && self.bottom >= other.top
    }
}

/// Place of a text: its baseline, and the side of the point on which it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    /// True if the text ends left of the point instead of beginning right of it.
    pub(super) leftward: bool,
    pub(super) x: f64,
    pub(super) baseline: f64,
}

/// Distance between a point and its text, in pixels.
const GAP: f64 = 7.0;

/// Returns a place beside a point for a text of a given width, in pixels: the first free place, else the
/// place with the least overlap with `taken` (other texts and points) and the outside of the frame. Adds the
/// place to `taken`.
pub(super) fn place(x: f64, y: f64, width: f64, frame: &Rect, taken: &mut Vec<Rect>) -> Place {
    let rect = |(leftward, down): (bool, f64)| {
        let left = if leftward { x - GAP - width } else { x + GAP };
        Rect { left, top: y + down - 11.0, right: left + width, bottom: y + down + 2.0 }
    };
    let places =
        [-5.0, 15.0, 4.0, -19.0, 29.0, -33.0, 43.0, -47.0, -61.0, -75.0, -89.0, -103.0, -117.0, -131.0]
            .into_iter()
            .flat_map(|down| [(false, down), (true, down)]);
    let clear = |rect: &Rect| frame.holds(rect) && !taken.iter().any(|t| t.meets(rect));
    let covered =
        |rect: &Rect| rect.area() - rect.shared(frame) + taken.iter().map(|t| t.shared(rect)).sum::<f64>();
    let found = places
        .clone()
        .find(|&place| clear(&rect(place)))
        .or_else(|| places.min_by(|&a, &b| covered(&rect(a)).total_cmp(&covered(&rect(b)))));
    let (leftward, down) = found.unwrap_or((false, 0.0));
    taken.push(rect((leftward, down)));
    Place { leftward, x: if leftward { x - GAP } else { x + GAP }, baseline: y + down }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_stay_inside_and_apart() {
        let frame = Rect { left: 0.0, top: 0.0, right: 200.0, bottom: 100.0 };
        let points = [(100.0, 50.0), (104.0, 52.0), (190.0, 20.0), (3.0, 97.0)];
        let mut taken: Vec<Rect> = points.iter().map(|(x, y)| Rect::around(*x, *y, 4.0)).collect();
        for (x, y) in points {
            place(x, y, 60.0, &frame, &mut taken);
        }
        let texts = &taken[points.len()..];
        assert!(texts.iter().all(|t| frame.holds(t)), "{texts:?}");
        for (i, text) in texts.iter().enumerate() {
            assert!(!texts[i + 1..].iter().any(|other| other.meets(text)), "{texts:?}");
        }
    }

    #[test]
    fn a_text_without_room_stands_where_it_covers_least() {
        let frame = Rect { left: 0.0, top: 0.0, right: 50.0, bottom: 30.0 };
        let found = place(40.0, 15.0, 80.0, &frame, &mut Vec::new());
        assert_eq!(found, Place { leftward: true, x: 33.0, baseline: 19.0 });
        // With texts all around, the place with the least overlap is chosen.
        let frame = Rect { left: 0.0, top: 0.0, right: 300.0, bottom: 200.0 };
        let mut taken = vec![
            Rect { left: 0.0, top: 0.0, right: 300.0, bottom: 120.0 },
            Rect { left: 158.0, top: 120.0, right: 300.0, bottom: 200.0 },
            Rect { left: 0.0, top: 120.0, right: 90.0, bottom: 200.0 },
        ];
        let found = place(150.0, 100.0, 60.0, &frame, &mut taken);
        assert_eq!(found, Place { leftward: true, x: 143.0, baseline: 143.0 });
    }
}
