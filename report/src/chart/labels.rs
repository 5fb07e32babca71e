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

/// Vertical distance of a text from its point, in pixels, beyond which a line joins them.
const JOIN_DISTANCE: f64 = 16.0;

/// Area of overlap, in square pixels, that counts as much as one text crossed by a joining line.
const CROSSING_AREA: f64 = 100.0;

impl Place {
    /// Vertical middle of the text.
    pub(super) fn middle(&self) -> f64 {
        self.baseline - 4.5
    }

    /// Line from the point (x, y) to a text that is not beside it.
    pub(super) fn line(&self, x: f64, y: f64) -> Option<[(f64, f64); 2]> {
        let middle = self.middle();
        let end = if self.leftward { self.x + 4.0 } else { self.x - 4.0 };
        ((middle - y).abs() > JOIN_DISTANCE).then_some([(x, y), (end, middle)])
    }
}

/// Places texts beside points, clear of marks and of each other.
#[derive(Debug, Default)]
pub(super) struct Places {
    /// Points and lines of the plot.
    pub(super) marks: Vec<Rect>,
    texts: Vec<Rect>,
}

impl Places {
    /// Returns a place beside the point (x, y) for a text of a given width, in pixels: the first free place,
    /// else the place with the least overlap with marks, texts and the outside of the frame; crossed texts
    /// count, too.
    pub(super) fn place(&mut self, x: f64, y: f64, width: f64, frame: &Rect) -> Place {
        let at = |(leftward, down): (bool, f64)| Place {
            leftward,
            x: if leftward { x - GAP } else { x + GAP },
            baseline: y + down,
        };
        let rect = |place: &Place| {
            let left = if place.leftward { place.x - width } else { place.x };
            Rect { left, top: place.baseline - 11.0, right: left + width, bottom: place.baseline + 2.0 }
        };
        let along = |place: &Place| place.line(x, y).into_iter().flat_map(|[a, b]| Rect::along(a, b));
        let places = [
            -5.0, 15.0, 4.0, -19.0, 29.0, -33.0, 43.0, -47.0, 57.0, -61.0, -75.0, -89.0, -103.0, -117.0,
            -131.0,
        ]
        .into_iter()
        .flat_map(|down| [(false, down), (true, down)])
        .map(at);
        let taken = || self.marks.iter().chain(&self.texts);
        // Number of texts that the line from the point crosses.
        let crossed =
            |place: &Place| self.texts.iter().filter(|t| along(place).any(|part| t.meets(&part))).count();
        let clear = |place: &Place| {
            let own = rect(place);
            frame.holds(&own) && !taken().any(|t| t.meets(&own)) && crossed(place) == 0
        };
        let covered = |place: &Place| {
            let own = rect(place);
            let shared = own.area() - own.shared(frame) + taken().map(|t| t.shared(&own)).sum::<f64>();
            shared + CROSSING_AREA * crossed(place) as f64
        };
        let found = places
            .clone()
            .find(clear)
            .or_else(|| places.min_by(|a, b| covered(a).total_cmp(&covered(b))))
            .unwrap_or(at((false, 0.0)));
        self.texts.push(rect(&found));
        self.marks.extend(along(&found));
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_stay_inside_and_apart() {
        let frame = Rect { left: 0.0, top: 0.0, right: 200.0, bottom: 100.0 };
        let points = [(100.0, 50.0), (104.0, 52.0), (190.0, 20.0), (3.0, 97.0)];
        let marks = points.iter().map(|(x, y)| Rect::around(*x, *y, 4.0)).collect();
        let mut places = Places { marks, texts: Vec::new() };
        for (x, y) in points {
            places.place(x, y, 60.0, &frame);
        }
        let texts = &places.texts;
        assert!(texts.iter().all(|t| frame.holds(t)), "{texts:?}");
        for (i, text) in texts.iter().enumerate() {
            assert!(!texts[i + 1..].iter().any(|other| other.meets(text)), "{texts:?}");
        }
    }

    #[test]
    fn a_text_without_room_stands_where_it_covers_least() {
        let frame = Rect { left: 0.0, top: 0.0, right: 50.0, bottom: 30.0 };
        let found = Places::default().place(40.0, 15.0, 80.0, &frame);
        assert_eq!(found, Place { leftward: true, x: 33.0, baseline: 19.0 });
        // With texts all around, the place with the least overlap is chosen.
        let frame = Rect { left: 0.0, top: 0.0, right: 300.0, bottom: 200.0 };
        let marks = vec![
            Rect { left: 0.0, top: 0.0, right: 300.0, bottom: 120.0 },
            Rect { left: 158.0, top: 120.0, right: 300.0, bottom: 200.0 },
            Rect { left: 0.0, top: 120.0, right: 90.0, bottom: 200.0 },
        ];
        let found = Places { marks, texts: Vec::new() }.place(150.0, 100.0, 60.0, &frame);
        assert_eq!(found, Place { leftward: true, x: 143.0, baseline: 143.0 });
    }
}
