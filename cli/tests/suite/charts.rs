//! The example's charts: well-formed XML, every kind of mark, and a page without external resources.

#[allow(dead_code, unreachable_pub, reason = "an example, with a main of its own")]
#[path = "../../examples/charts.rs"]
mod example;

use quick_xml::events::Event;

/// Returns the names and classes of the elements; fails if the text is not well-formed.
fn walk(svg: &str) -> Vec<String> {
    let mut reader = quick_xml::Reader::from_str(svg);
    let mut found = Vec::new();
    loop {
        match reader.read_event().unwrap() {
            Event::Start(tag) | Event::Empty(tag) => {
                let classes = tag.attributes().map(|a| a.unwrap()).filter(|a| a.key.as_ref() == "class");
                found.extend(classes.map(|a| a.value.to_string()));
                found.push(tag.name().as_ref().to_owned());
            }
            Event::Eof => return found,
            _ => {}
        }
    }
}

#[test]
fn every_kind_of_chart_is_drawn() {
    let mut classes = std::collections::BTreeSet::new();
    for (name, chart) in example::samples() {
        let svg = chart.to_svg_file();
        let elements = walk(&svg);
        assert_eq!(elements[1], "svg", "{name}");
        assert!(elements.iter().filter(|e| *e == "text").count() >= 4, "{name} lacks texts");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{name}");
        classes.extend(elements);
    }
    for class in ["line", "steps", "points", "band", "boxes", "rule"] {
        assert!(classes.contains(class), "no {class} among {classes:?}");
    }
}

#[test]
fn the_page_holds_every_chart_and_fetches_nothing() {
    let html = example::page().finish();
    assert_eq!(html.matches("<svg").count(), example::samples().len());
    for word in ["http:", "https:", "src=\"//", "url(", "@import", "<script", "<link"] {
        assert!(!html.contains(word), "{word}");
    }
}
