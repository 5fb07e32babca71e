//! Tests of tables, manifests and noise floors.

use super::*;
use crate::metrics::median;
use entire_core::scene::{Arcball, GaussianLobe, Shading, Skipping};
use entire_vk_raycaster::WorkCounts;
use proptest::prelude::*;
use std::collections::BTreeMap;

fn scene() -> Scene {
    Scene {
        time_step: Some(3),
        dims: [96, 64, 1],
        camera: Arcball { rx: -12.345_678, ry: 170.0, dz: 1.75 },
        width: 320,
        height: 200,
        step: 1.5,
        shading: Shading::Local,
        skipping: Skipping::Distance,
        lobes: vec![
            GaussianLobe { center: 0.1, width: 0.003, height: 0.9 },
            GaussianLobe { center: 1.0 / 3.0, width: 1e-5, height: 0.0 },
        ],
        ..TimedFrame::of_no_volume("data/a, \"b\".nrrd", "m01").scene
    }
}

fn measured(wall: f64) -> Timing {
    let counts = Some(WorkCounts { rays: 7, samples: u64::from(u32::MAX) * 9, skips: 0, shaded: 2 });
    Timing { device: None, wall: Some(wall), cpu: Some(wall * 1.7), counts }
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

#[test]
fn a_written_table_reads_back_bit_for_bit() {
    let dir = folder();
    let path = dir.path().join("t.csv");
    let mut writer = Writer::create(&path).unwrap();
    writer.append(4, &scene(), &[measured(0.1), measured(0.3), measured(0.2)]).unwrap();
    let name = " a.nrrd ".into();
    let bare = Scene { volume: name, member: String::new(), time_step: None, lobes: vec![], ..scene() };
    let lone = Timing { device: Some(1e-7), ..Timing::default() };
    writer.append(9, &bare, &[lone]).unwrap();
    let table = Table::read(&path, 2).unwrap();
    assert_eq!(table.frames.len(), 2);
    assert_eq!((table.frames[0].number, table.frames[0].table), (4, 2));
    assert_eq!(table.frames[0].scene, scene());
    assert_eq!(table.frames[0].repeats, [measured(0.1), measured(0.3), measured(0.2)]);
    assert_eq!(table.frames[1].scene, bare);
    assert_eq!(table.frames[1].repeats, [lone]);
    assert_eq!(table.frames[0].seconds(Clock::Wall), Some(0.2));
    assert_eq!(table.frames[0].seconds(Clock::Cpu), Some(0.2 * 1.7));
    assert_eq!(table.frames[0].seconds(Clock::Device), None);
    assert_eq!(table.frames[1].seconds(Clock::Device), Some(1e-7));
    assert!(writer.append(9, &bare, &[lone]).unwrap_err().to_string().contains("already"));
    assert!(Writer::create(&path).unwrap_err().to_string().contains("resume"));
    // Tables whose names differ only in .csv and .gz would share one manifest. Tables are written without
    // compression.
    let (packed, other) = (path.with_extension("csv.gz"), path.with_file_name("other.csv"));
    assert!(Writer::create(&packed).unwrap_err().to_string().contains("leave .gz out"));
    std::fs::write(other.with_extension("csv.gz"), "").unwrap();
    let bare = path.with_extension("");
    for shared in [&other, &bare] {
        assert!(Writer::create(shared).unwrap_err().to_string().contains("share its manifest"), "{shared:?}");
    }
    // A file or folder that is no table has no manifest.
    std::fs::create_dir(dir.path().join("run")).unwrap();
    Writer::create(&dir.path().join("run.csv")).unwrap();
}

proptest! {
    #[test]
    fn lobes_survive_text(values in prop::collection::vec((any::<f32>(), any::<f32>(), any::<f32>()), 0..6)) {
        prop_assume!(values.iter().all(|(a, b, c)| a.is_finite() && b.is_finite() && c.is_finite()));
        let lobes: Vec<_> = values.iter()
            .map(|&(center, width, height)| GaussianLobe { center, width, height }).collect();
        prop_assert_eq!(parse_lobes(&format_lobes(&lobes)).unwrap(), lobes);
    }
}

#[test]
fn resuming_repairs_any_cut_and_keeps_whole_frames() {
    let dir = folder();
    let path = dir.path().join("t.csv");
    let mut writer = Writer::create(&path).unwrap();
    for n in 0..3 {
        writer.append(n, &scene(), &[measured(0.1), measured(0.2)]).unwrap();
    }
    drop(writer);
    let whole = std::fs::read(&path).unwrap();
    let frame_ends: Vec<usize> =
        whole.iter().enumerate().filter(|(_, b)| **b == b'\n').map(|(i, _)| i + 1).step_by(2).collect();
    for cut in 0..=whole.len() {
        std::fs::write(&path, &whole[..cut]).unwrap();
        let mut writer = Writer::resume(&path, 2).unwrap();
        let kept = frame_ends.iter().filter(|e| **e <= cut).count().saturating_sub(1);
        assert_eq!(writer.done().len(), kept, "cut at {cut}");
        for n in kept as u64..3 {
            writer.append(n, &scene(), &[measured(0.1), measured(0.2)]).unwrap();
        }
        drop(writer);
        assert_eq!(std::fs::read(&path).unwrap(), whole, "cut at {cut}");
    }
    std::fs::write(&path, "something else\n").unwrap();
    assert!(Writer::resume(&path, 2).unwrap_err().to_string().contains("first line"));
}

#[test]
fn a_table_has_one_writer_at_a_time() {
    let dir = folder();
    let path = dir.path().join("t.csv");
    let mut first = Writer::create(&path).unwrap();
    first.append(0, &scene(), &[measured(0.1)]).unwrap();
    let said = Writer::resume(&path, 1).unwrap_err().to_string();
    assert!(said.contains("t.csv is locked: another process writes this table"), "{said}");
    first.append(1, &scene(), &[measured(0.1)]).unwrap();
    drop(first);
    let mut second = Writer::resume(&path, 1).unwrap();
    second.append(2, &scene(), &[measured(0.1)]).unwrap();
    assert!(Writer::resume(&path, 1).is_err());
    drop(second);
    assert_eq!(Table::read(&path, 0).unwrap().frames.len(), 3);
}

#[test]
fn every_wrong_field_is_named_with_its_line_and_column() {
    let dir = folder();
    let path = dir.path().join("t.csv");
    let plain = Scene { volume: "v.nrrd".into(), ..scene() };
    Writer::create(&path).unwrap().append(0, &plain, &[measured(0.1)]).unwrap();
    let good = std::fs::read_to_string(&path).unwrap();
    let line: Vec<String> = good.lines().nth(1).unwrap().split(',').map(str::to_owned).collect();
    let says = |text: &str| {
        std::fs::write(&path, text).unwrap();
        format!("{:#}", Table::read(&path, 0).unwrap_err())
    };
    let with = |column: &str, value: &str| {
        let mut fields = line.clone();
        fields[COLUMNS.iter().position(|c| *c == column).unwrap()] = value.to_owned();
        says(&format!("{}\n{}\n", COLUMNS.join(","), fields.join(",")))
    };
    for (column, value, expected) in [
        ("frame", "x", "column frame is \"x\""),
        ("repeat", "-1", "column repeat"),
        ("volume", "", "volume's name is empty"),
        ("dims_y", "0", "holds a 0"),
        ("dims_z", "1.5", "column dims_z"),
        ("camera_rx_deg", "NaN", "finite degrees"),
        ("camera_dz_radii", "0", "camera distance is 0"),
        ("fov_y_deg", "200", "field of view"),
        ("width_px", "0", "image size is 0"),
        ("step_ref", "0", "ray step is 0"),
        ("shading", "phong", "none, local, scatter or local-scatter"),
        ("skipping", "octree", "none, blocks or distance"),
        ("termination", "1.5", "termination opacity"),
        ("tf", "0.1 0.2", "three numbers"),
        ("tf", "0.1 0 1", "width is 0"),
        ("seconds_wall", "-1", "seconds_wall is -1"),
        ("seconds_wall", "inf", "seconds_wall is inf"),
        ("seconds_cpu", "fast", "column seconds_cpu"),
        ("samples", "-3", "column samples"),
        ("samples", "1.5", "a whole number or an empty field"),
    ] {
        let message = with(column, value);
        assert!(message.contains(expected) && message.contains("line 2"), "{column}={value}: {message}");
    }
    let again = line.join(",");
    let other = again.replacen("0,0,", "0,1,", 1).replace("320", "321");
    assert!(says(&good.replacen("step_ref", "step", 1)).contains("\"step_ref\" is missing"));
    assert!(says(&good[..good.len() - 30]).contains("26 expected"));
    assert!(says(&format!("{good}{again}\n")).contains("line 3: frame 0, repeat 0"));
    assert!(says(&format!("{good}{other}\n")).contains("another scene"));
    std::fs::write(&path, format!("{}\n", COLUMNS.join(","))).unwrap();
    assert!(read_tables(std::slice::from_ref(&path)).unwrap_err().to_string().contains("no frames"));
}

#[test]
fn a_timing_table_is_told_from_other_files() {
    let dir = folder();
    let (table, other) = (dir.path().join("t.csv"), dir.path().join("o.csv"));
    ensure_no_table(&table).unwrap();
    Writer::create(&table).unwrap().append(0, &scene(), &[measured(0.1)]).unwrap();
    let said = ensure_no_table(&table).unwrap_err().to_string();
    assert!(said.ends_with("t.csv is a timing table; choose another name"), "{said}");
    for text in ["", "frame,controller,switch\n", "frame,repeat"] {
        std::fs::write(&other, text).unwrap();
        ensure_no_table(&other).unwrap();
    }
}

#[test]
fn a_table_that_is_given_twice_is_refused() {
    let dir = folder();
    let path = dir.path().join("t.csv");
    Writer::create(&path).unwrap().append(0, &scene(), &[measured(0.1)]).unwrap();
    let other = dir.path().join("..").join(dir.path().file_name().unwrap()).join("t.csv");
    for twice in [&path, &other] {
        let said = open_tables(&[path.clone(), twice.clone()], None).unwrap_err().to_string();
        assert!(said.contains("t.csv is given twice"), "{said}");
    }
    let root = Some(dir.path());
    assert_eq!(open_tables(&[path], root).unwrap()[0].root.as_deref(), root);
}

#[test]
fn the_writer_refuses_what_could_not_be_read_back() {
    let dir = folder();
    let mut writer = Writer::create(&dir.path().join("t.csv")).unwrap();
    let newline = Scene { volume: "a\nb".into(), ..scene() };
    assert!(writer.append(0, &newline, &[measured(0.1)]).is_err());
    assert!(writer.append(0, &scene(), &[]).is_err());
    assert!(writer.append(0, &scene(), &[Timing::default()]).is_err());
    let wall = |seconds| Timing { wall: Some(seconds), ..Timing::default() };
    for seconds in [1.0e300, f64::INFINITY, f64::NAN, -1.0] {
        assert!(writer.append(0, &scene(), &[wall(seconds)]).is_err(), "{seconds}");
    }
    writer.append(0, &scene(), &[wall(9000.0)]).unwrap();
}

/// Returns a frame with one repeat for each of `logs`; a repeat takes `seconds` · e^log.
fn repeated(number: u64, seconds: f64, logs: &[f64]) -> TimedFrame {
    let repeats = logs.iter().map(|l| measured(seconds * l.exp())).collect();
    TimedFrame { table: 0, number, scene: scene(), repeats }
}

#[test]
fn noise_floor_is_the_middle_difference_of_repeats() {
    // The logarithms of the two repeats differ by 0.2. So the standard deviation of one repeat is 0.2 /
    // (0.6745·√2), and that of the mean of both is smaller by a factor of √2.
    let frame = |t: f64| repeated(0, t, &[0.1, -0.1]);
    let floor = noise_floor(&[frame(1.0), frame(20.0)], Clock::Wall, |_| 1).unwrap();
    assert!((floor.log_sd - 0.209_671).abs() < 1e-6, "{floor:?}");
    assert!((floor.log_sd_of_median - floor.log_sd / 2f64.sqrt()).abs() < 1e-12);
    assert!((floor.warm_up - 0.2).abs() < 1e-12);
    assert_eq!((floor.frames, floor.drift), (2, None));
    let mut once = frame(1.0);
    once.repeats.pop();
    assert_eq!(noise_floor(&[once], Clock::Wall, |_| 1), None);
    assert_eq!(noise_floor(&[frame(1.0)], Clock::Device, |_| 1), None);
}

#[test]
fn tails_warm_up_and_drift_do_not_lift_the_noise_floor() {
    use rand::{RngExt, SeedableRng};
    let mut rng = rand::rngs::ChaCha8Rng::seed_from_u64(5);
    // The sum of twelve uniform numbers less 6 has a standard deviation of 1.
    let mut normal = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
    let frames: Vec<TimedFrame> = (0..2000u32)
        .map(|i| {
            let seconds = 1e-3 * 1.005f64.powi(i as i32 / 2);
            // The first repeat of a pass is slower than the others, above all in fast frames; the second pass
            // is 10 % slower than the first.
            let warm_up = if i < 600 { 0.4 } else { 0.05 };
            let tail = if i % 50 == 0 { 2.0 } else { 0.0 };
            let logs: Vec<f64> = [0.0, 0.1]
                .iter()
                .flat_map(|pass| [pass + warm_up, *pass, pass + tail])
                .map(|common| common + 0.03 * normal())
                .collect();
            repeated(u64::from(i), seconds, &logs)
        })
        .collect();
    let floor = noise_floor(&frames, Clock::Wall, |_| 2).unwrap();
    assert!((floor.log_sd - 0.03).abs() < 2e-3, "{floor:?}");
    assert!((floor.log_sd_of_median - 0.03 * (std::f64::consts::FRAC_PI_2 / 6.0).sqrt()).abs() < 1e-3);
    assert!((floor.drift.unwrap() - 0.1).abs() < 5e-3, "{floor:?}");
    // In three of ten frames, ln(first / last repeat) is about 0.4. So the median over all frames is the 5/7
    // quantile of the other frames, whose differences of two repeats have a standard deviation of 0.03·√2.
    assert!((floor.warm_up - (0.05 + 0.566 * 0.03 * 2f64.sqrt())).abs() < 5e-3, "{floor:?}");
}

#[test]
fn medians_ignore_zero_times_and_take_the_middle() {
    assert_eq!(median(&mut []), None);
    assert_eq!(median(&mut [3.0, 1.0, 2.0, 10.0]), Some(2.5));
    let frame =
        TimedFrame { table: 0, number: 0, scene: scene(), repeats: vec![measured(0.0), measured(0.5)] };
    assert_eq!(frame.seconds(Clock::Wall), Some(0.5));
}

#[test]
fn frames_without_the_clock_are_left_out_by_number() {
    let without = Timing { cpu: None, ..measured(0.1) };
    let frame = |number, repeats| TimedFrame { table: 0, number, scene: scene(), repeats };
    let table = |frames| Table { path: "t.csv".into(), frames, ..Table::default() };
    let frames = [measured(0.1), without, without].map(|t| frame(0, vec![t]));
    let tables = [table(frames.to_vec())];
    let text = left_out(&tables, Clock::Cpu, None).unwrap();
    for part in ["2 of 3 frames", "no cpu time", "--clock wall"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert_eq!(timed(&tables, Clock::Cpu, None).unwrap().len(), 1);
    assert_eq!(left_out(&tables, Clock::Wall, None), None);
    assert_eq!(left_out(&tables, Clock::Cpu, Some(Shading::Scatter)), None);
    // If no frame has the clock, there is no note, since `timed` returns an error.
    assert_eq!(left_out(&tables, Clock::Device, None), None);
    assert!(timed(&tables, Clock::Device, None).unwrap_err().to_string().contains("choose another --clock"));
    // No clock has times of all frames.
    let lone = Timing { cpu: Some(0.2), ..Timing::default() };
    let tables = [table(vec![frame(0, vec![lone]), frame(1, vec![without])])];
    let text = left_out(&tables, Clock::Wall, None).unwrap();
    assert!(text.contains("1 of 2 frames") && !text.contains("--clock"), "{text}");
}

#[test]
fn a_mixture_of_renderers_is_named_and_unused_tables_do_not_count() {
    let of = |renderer: &str| Manifest { renderer: renderer.into(), ..Manifest::default() };
    let tables = ["vulkan", "yt", "vulkan"].map(|r| Table { manifest: Some(of(r)), ..Table::default() });
    let frames = [0, 1, 2].map(|table| TimedFrame { table, ..TimedFrame::of_no_volume("v", "") });
    let same = manifests_of(&tables, &[&frames[2], &frames[0], &frames[2]]);
    assert_eq!((same.len(), mixed(&same)), (2, None));
    assert_eq!(manifests_of(&tables, &[&frames[1]])[0].renderer, "yt");
    let text = mixed(&manifests_of(&tables, &[&frames[0], &frames[1]])).unwrap();
    assert!(text.contains("of 2 renderers or machines") && text.contains("yt on"), "{text}");
}

#[test]
fn manifests_keep_unknown_keys_and_refuse_other_formats() {
    let dir = folder();
    let table = dir.path().join("run.v2.csv");
    assert_eq!(Manifest::path_for(&table), dir.path().join("run.v2.manifest.json"));
    assert_eq!(Manifest::path_for(&dir.path().join("run.v2.csv.gz")), Manifest::path_for(&table));
    assert_eq!(Manifest::path_for(&dir.path().join("run.1")), dir.path().join("run.1.manifest.json"));
    assert_eq!(Manifest::read(&table).unwrap(), None);
    let mut manifest = Manifest {
        format: MANIFEST_FORMAT.into(),
        created: "2020-01-02T03:04:05Z".into(),
        machine: "host".into(),
        renderer: "cpu".into(),
        device: "twin".into(),
        driver: "none".into(),
        commit: "0.1.0".into(),
        seed: u64::MAX,
        repeats: 3,
        step_reference: STEP_REFERENCE.into(),
        settings: serde_json::json!({"frames": 10}),
        files: BTreeMap::new(),
        other: BTreeMap::from([("weather".to_owned(), serde_json::json!("fine"))]),
    };
    manifest.write(&table).unwrap();
    assert_eq!(Manifest::read(&table).unwrap(), Some(manifest.clone()));
    manifest.format = "2".into();
    manifest.write(&table).unwrap();
    let said = format!("{:#}", Manifest::read(&table).unwrap_err());
    assert!(said.contains("entire-timings-1"), "{said}");
}

#[test]
fn a_table_is_fresh_until_its_first_row() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.csv");
    assert!(Writer::is_fresh(&path).unwrap());
    drop(Writer::create(&path).unwrap());
    let header = std::fs::read(&path).unwrap();
    for cut in 0..=header.len() {
        std::fs::write(&path, &header[..cut]).unwrap();
        assert!(Writer::is_fresh(&path).unwrap(), "{cut}");
        drop(Writer::resume(&path, 1).unwrap());
        assert_eq!(std::fs::read(&path).unwrap(), header, "{cut}");
        std::fs::write(&path, &header[..cut]).unwrap();
        drop(Writer::create(&path).unwrap());
        assert_eq!(std::fs::read(&path).unwrap(), header, "{cut}");
    }
    std::fs::write(&path, [&header[..], b"0"].concat()).unwrap();
    assert!(!Writer::is_fresh(&path).unwrap());
}

#[cfg(unix)]
#[test]
fn what_is_no_regular_file_is_no_table() {
    for path in ["/dev/zero", "/"] {
        let said = format!("{:#}", Table::read(std::path::Path::new(path), 0).unwrap_err());
        assert!(said.contains(path), "{said}");
    }
}
