use super::*;
use quick_xml::events::{BytesStart, Event};

/// An element: its name, its attributes, and the classes of the groups that contain it.
#[derive(Debug)]
struct Element {
    name: String,
    attributes: Vec<(String, String)>,
    groups: Vec<String>,
}

impl Element {
    fn get(&self, key: &str) -> &str {
        self.attributes.iter().find(|(k, _)| k == key).map_or("", |(_, v)| v)
    }

    fn numbers(&self) -> Vec<f64> {
        let keys = ["points", "x", "y", "width", "height", "cx", "cy", "r", "x1", "y1", "x2", "y2"];
        let words = keys.iter().flat_map(|key| self.get(key).split([' ', ',']).collect::<Vec<_>>());
        words.filter(|word| !word.is_empty()).map(|word| word.parse().unwrap()).collect()
    }

    fn corners(&self) -> Vec<(f64, f64)> {
        self.numbers().chunks(2).map(|p| (p[0], p[1])).collect()
    }
}

/// Parses a chart as XML. Returns its elements and its texts.
fn elements(svg: &str) -> (Vec<Element>, Vec<String>) {
    fn attributes(tag: &BytesStart<'_>) -> Vec<(String, String)> {
        let version = quick_xml::XmlVersion::Implicit1_0;
        tag.attributes()
            .map(|a| a.unwrap())
            .map(|a| (a.key.as_ref().to_owned(), a.normalized_value(version).unwrap().into_owned()))
            .collect()
    }
    let mut reader = quick_xml::Reader::from_str(svg);
    let (mut found, mut texts, mut groups) = (Vec::new(), Vec::new(), Vec::new());
    loop {
        match reader.read_event().unwrap() {
            Event::Start(tag) | Event::Empty(tag) if tag.name().as_ref() != "g" => {
                let (name, attributes) = (tag.name().as_ref().to_owned(), attributes(&tag));
                found.push(Element { name, attributes, groups: groups.clone() });
            }
            Event::Start(tag) => groups.push(attributes(&tag)[0].1.clone()),
            Event::End(tag) if tag.name().as_ref() == "g" => {
                groups.pop();
            }
            Event::Text(text) => texts.push(text.to_string().trim().to_owned()),
            Event::Eof => return (found, texts),
            _ => {}
        }
    }
}

/// Returns the elements in the layers of one class.
fn of_class(svg: &str, class: &str) -> Vec<Element> {
    elements(svg).0.into_iter().filter(|e| e.groups.iter().any(|g| g == class)).collect()
}

#[test]
fn points_stand_where_their_values_are() {
    let points = [(0.0, 1.0), (5.0, 10.0), (10.0, 100.0)].map(|(x, y)| (x, y, String::new())).to_vec();
    let svg = Chart::new("", Axis::linear("x").from(0.0).to(10.0), Axis::log("y").from(1.0).to(100.0))
        .series(Series::new("", Mark::Points(points)))
        .to_svg();
    let places: Vec<(f64, f64)> = of_class(&svg, "points")
        .iter()
        .map(|c| (c.get("cx").parse().unwrap(), c.get("cy").parse().unwrap()))
        .collect();
    let [(x0, y0), (x1, y1), (x2, y2)] = places[..] else { panic!("{places:?}") };
    assert!(x2 - x0 > 5000.0 && y0 - y2 > 1000.0, "{places:?}");
    assert!((x1 - (x0 + x2) / 2.0).abs() <= 1.0 && (y1 - (y0 + y2) / 2.0).abs() <= 1.0, "{places:?}");
}

#[test]
fn marks_beyond_a_fixed_end_are_cut_off_at_the_frame() {
    let svg = Chart::new("", Axis::linear("x").from(0.0).to(10.0), Axis::linear("y").from(0.0).to(1.0))
        .series(Series::new("", Mark::Line(vec![(-5.0, -1.0), (5.0, 0.5), (15.0, 1e12)])))
        .series(Series::new("", Mark::Points(vec![(5.0, 7.0, "far".into()), (5.0, 0.5, "near".into())])))
        .series(Series::new("", Mark::Boxes(vec![(4.0, [0.1, 0.4, 2.0, 3.0, 4.0])])))
        .to_svg();
    let (all, texts) = elements(&svg);
    let frame = all.iter().rev().find(|e| e.name == "polyline").unwrap().corners();
    let (low, high) = (frame[0], frame[2]);
    let inside = |&(x, y): &(f64, f64)| (low.0..=high.0).contains(&x) && (low.1..=high.1).contains(&y);
    let marks: Vec<&Element> = all.iter().filter(|e| !e.groups.is_empty()).collect();
    assert!(
        marks.iter().filter(|e| e.name == "polyline").all(|e| e.corners().iter().all(inside)),
        "{marks:?}"
    );
    assert_eq!(of_class(&svg, "points").len(), 1);
    assert!(texts.contains(&"near".to_owned()) && !texts.contains(&"far".to_owned()));
    // The median lies beyond the frame: only the lower whisker and two parts of the box's outline remain.
    let lines = of_class(&svg, "boxes");
    assert_eq!(lines.iter().filter(|e| e.name == "polyline").count(), 3, "{lines:?}");
}

#[test]
fn series_share_a_slot_side_by_side() {
    let names = vec!["p".to_owned(), "q".to_owned()];
    let boxes =
        |low: f64| vec![(0.0, [0.0, 1.0, 2.0, 3.0, 4.0].map(|q| low + q)), (1.0, [0.0, 2.0, 3.0, 4.0, 9.0])];
    let svg = Chart::new("", Axis::categories("", names), Axis::linear("y"))
        .series(Series::new("a", Mark::Boxes(boxes(0.0))))
        .series(Series::new("b", Mark::Boxes(boxes(3.0))))
        .to_svg();
    let mut places: Vec<(f64, f64)> = of_class(&svg, "boxes")
        .iter()
        .filter(|e| e.name == "rect")
        .map(|b| ["x", "width"].map(|key| b.get(key).parse::<f64>().unwrap()).into())
        .collect();
    places.sort_by(|a, b| a.0.total_cmp(&b.0));
    assert_eq!(places.len(), 4);
    assert!(places.windows(2).all(|w| w[0].0 + w[0].1 <= w[1].0), "{places:?}");
}

#[test]
fn names_are_escaped_and_standalone_files_carry_their_namespace() {
    let c = Chart::new("a < b & \"c\"", Axis::linear("x"), Axis::linear("y"))
        .series(Series::new("<i>", Mark::Points(vec![(0.0, 0.0, "<b>".into())])));
    let svg = c.to_svg();
    let (all, texts) = elements(&svg);
    assert_eq!(all[0].get("aria-label"), "a < b & \"c\"");
    assert!(!svg.contains("<b>") && !svg.contains("<i>"), "{svg}");
    for name in ["x", "y"] {
        assert!(texts.iter().any(|t| t == name), "{texts:?}");
    }
    assert!(!svg.contains("http") && c.to_svg_file().contains("xmlns"));
}

#[test]
fn every_color_has_its_counterpart_on_a_dark_ground() {
    let mut c = Chart::new("t", Axis::linear("x"), Axis::linear("y"));
    for color in 0..PALETTE.len() {
        c = c.series(Series::new("s", Mark::Line(vec![(0.0, 0.0), (1.0, color as f64)])).color(color));
    }
    let svg = c.to_svg();
    let (all, _) = elements(&svg);
    let dark = &svg[svg.find("prefers-color-scheme:dark").unwrap()..];
    for key in ["fill", "stroke"] {
        for color in all.iter().map(|e| e.get(key)).filter(|color| color.starts_with('#')) {
            assert!(dark.contains(&format!("[{key}=\"{color}\"]{{{key}:#")), "{key} {color}");
        }
    }
}

#[test]
fn every_kind_of_chart_is_drawn() {
    let wave = |shift: f64| -> Vec<(f64, f64)> {
        (0..120).map(f64::from).map(|x| (x, 18.0 + 3.0 * (0.21 * x + shift).sin())).collect()
    };
    let mut broken = wave(2.0);
    broken[20].1 = f64::NAN;
    let band = wave(1.0).into_iter().map(|(x, y)| (x, 16.0, 50.0 + y)).collect();
    let cloud = wave(0.0).into_iter().map(|(x, y)| (0.004 * 1.05f64.powf(x), y, String::new())).collect();
    let places = [(0.8, 22.0), (1.0, 20.5), (1.05, 20.4), (4.0, 14.0), (4.2, 13.9), (300.0, 8.7)];
    let named = places.map(|(x, y)| (x, y, format!("predictor at {x}")));
    let boxes = |by: f64| (0..3).map(|i| (f64::from(i), [0.2, 0.6, 1.0, 1.7, 4.0].map(|q| q * by))).collect();
    let scenes = || ["zoom", "isovalue sweep", "switching light"].map(str::to_owned).to_vec();
    let worst = [(1.0, 0.0), (1.3, 1.0), (2.4, 2.0), (1.1, 0.0)].map(|(x, y)| (x, y, String::new()));
    let charts = [
        Chart::new("Frame time", Axis::linear("frame"), Axis::log("frame time / ms"))
            .size(900.0, 380.0)
            .rule(Rule::Vertical(40.0, "switch 1".into()))
            .rule(Rule::Horizontal(60.0, "limit".into()))
            .series(Series::new("target", Mark::Steps(wave(0.0))).color(10))
            .series(Series::new("reference step", Mark::Band(band)).color(6))
            .series(Series::new("PID", Mark::Line(broken))),
        Chart::new("Predicted over measured", Axis::log("measured / s"), Axis::log("predicted / s"))
            .series(Series::new("held-out frames", Mark::Points(cloud)))
            .rule(Rule::Diagonal("exact".into())),
        Chart::new("Error against latency", Axis::log("latency / µs"), Axis::linear("error / %").from(0.0))
            .series(Series::new("", Mark::Line(places.to_vec())).color(5))
            .series(Series::new("predictors", Mark::Points(named.to_vec()))),
        Chart::new("Errors", Axis::categories("scene", scenes()), Axis::log("absolute error / %"))
            .series(Series::new("OLP", Mark::Boxes(boxes(2.0))))
            .series(Series::new("network", Mark::Boxes(boxes(1.0)))),
        Chart::new("Worst frame", Axis::linear("t / T").from(0.0).to(2.0), Axis::categories("", scenes()))
            .series(Series::new("hybrid", Mark::Points(worst.to_vec())))
            .series(Series::new("late", Mark::Stretches(vec![(1.0, 1.5, 0.0), (0.5, 3.0, 2.0)]))),
        Chart::new("Nothing measured", Axis::log("x"), Axis::linear("y")).size(500.0, 200.0),
    ];
    let mut classes = std::collections::BTreeSet::new();
    for chart in charts {
        let svg = chart.to_svg_file();
        let (all, _) = elements(&svg);
        assert_eq!(all[0].name, "svg", "{}", chart.title);
        assert!(all.iter().filter(|e| e.name == "text").count() >= 4, "{} lacks texts", chart.title);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{}", chart.title);
        classes.extend(all.into_iter().flat_map(|e| e.groups));
    }
    for class in ["line", "steps", "points", "band", "boxes", "stretches", "rule"] {
        assert!(classes.contains(class), "no {class} among {classes:?}");
    }
}
