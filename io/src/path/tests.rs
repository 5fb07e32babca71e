//! Tests of path files and generated paths.

use super::*;
use entire_core::scene::{Scalars, VolumeView};

const GOOD: &str = r#"{
    "format": "entire-path-1", "frames": 11,
    "keyframes": [
        {"frame": 0, "camera": {"rx_deg": 0, "ry_deg": 0, "dz_radii": 4},
         "transfer": {"lobes": [{"center": 0.2, "width": 0.01, "height": 0.5}]}},
        {"frame": 4, "transfer": {"lobes": [{"center": 0.6, "width": 0.04, "height": 0.1}]}},
        {"frame": 6, "switch": true, "transfer":
             {"points": [{"position": 0.5, "color": [1, 0, 0], "opacity": 0.5}]}},
        {"frame": 10, "camera": {"rx_deg": 50, "ry_deg": -100, "dz_radii": 1}}
    ]}"#;

fn good() -> FlightPath {
    PathFile::parse(GOOD).unwrap().resolve().unwrap()
}

#[test]
fn tracks_interpolate_hold_and_switch() {
    let p = good();
    assert_eq!((p.frames.len(), p.fov_y_degrees), (11, 45.0));
    let camera = p.frames[5].camera;
    assert!(
        (camera.rx - 25.0).abs() < 1e-4 && (camera.ry + 50.0).abs() < 1e-4 && (camera.dz - 2.0).abs() < 1e-5
    );
    let Transfer::Lobes(lobes) = p.frames[2].transfer.get().into_owned() else { panic!() };
    assert!((lobes[0].center - 0.4).abs() < 1e-6 && (lobes[0].width - 0.02).abs() < 1e-6);
    assert!((lobes[0].height - 0.3).abs() < 1e-6);
    // The old transfer function holds before frame 6, where the switch is; the new one holds from there on.
    assert_eq!(p.frames[5].transfer, p.frames[4].transfer);
    assert!(matches!(*p.frames[6].transfer.get(), Transfer::Points(_)));
    assert_eq!(p.frames[10].transfer, p.frames[6].transfer);
    assert_eq!(p.switches(), [6]);
    let changed: Vec<usize> = (0..11).filter(|i| p.frames[*i].transfer_changed).collect();
    assert_eq!(changed, [0, 1, 2, 3, 4, 6]);
    assert!(!p.frames.iter().any(|f| f.camera_switched));
}

#[test]
fn interpolation_stays_between_its_ends_where_a_camera_may_be_no_farther() {
    let text = GOOD
        .replace("\"dz_radii\": 4", "\"dz_radii\": 1e6")
        .replace("\"dz_radii\": 1}", "\"dz_radii\": 1e6}");
    let path = PathFile::parse(&text).unwrap().resolve().unwrap();
    for i in 0..path.frames.len() {
        assert_eq!(path.frames[i].camera.dz, 1e6, "{i}");
        assert!(path.camera(i).is_ok());
    }
}

#[test]
fn parallel_cameras_are_interpolated_in_their_scale_and_switch_to_others() {
    let text = GOOD.replacen("\"dz_radii\": 4}", "\"dz_radii\": 4, \"parallel_scale\": 1.6}", 1).replacen(
        "\"dz_radii\": 1}",
        "\"dz_radii\": 1, \"parallel_scale\": 0.4}",
        1,
    );
    let file = PathFile::parse(&text).unwrap();
    assert_eq!(PathFile::parse(&serde_json::to_string(&file).unwrap()).unwrap(), file);
    let path = file.resolve().unwrap();
    let scale = path.frames[5].parallel_scale.unwrap();
    assert!((scale - 0.8).abs() < 1e-5, "{scale}");
    let at = |i: usize| path.frames[i].camera;
    let expected = Camera::from_arcball(at(5)).unwrap().with_parallel_scale(scale).unwrap();
    assert_eq!(path.camera(5).unwrap(), expected);
    assert_eq!(good().camera(5).unwrap(), Camera::from_arcball(at(5)).unwrap());
    // Between a parallel and a perspective camera, a path can only switch.
    let other = |more: &str| {
        let last = format!("\"dz_radii\": 1}}{more}}}");
        PathFile::parse(&text.replacen("\"dz_radii\": 1, \"parallel_scale\": 0.4}}", &last, 1))
            .unwrap()
            .resolve()
    };
    let said = format!("{:#}", other("").unwrap_err());
    assert!(said.contains("keyframe 3 (frame 10)") && said.contains("\"switch\": true"), "{said}");
    let path = other(", \"switch\": true").unwrap();
    let scales = [9, 10].map(|i: usize| path.frames[i].parallel_scale);
    assert_eq!((scales, path.switches()), ([Some(1.6), None], vec![6, 10]));
}

#[test]
fn every_mistake_is_named() {
    let wrong = |from: &str, to: &str| {
        assert!(GOOD.contains(from), "{from}");
        let error = PathFile::parse(&GOOD.replacen(from, to, 1)).and_then(|f| f.resolve()).unwrap_err();
        format!("{error:#}")
    };
    for (from, to, expected) in [
        ("entire-path-1", "entire-path-9", "this version reads \"entire-path-1\""),
        ("\"frames\": 11", "\"frames\": 0", "frames is 0"),
        ("\"frames\": 11", "\"frames\": 9000000", "1 to 1000000"),
        ("\"frames\": 11", "\"frames\": 10", "keyframe 3 (frame 10): the path has frames 0 to 9"),
        ("\"frames\": 11", "\"frames\": \"x\"", "line 2"),
        ("\"frame\": 0", "\"frame\": 1", "first keyframe must be at frame 0"),
        ("\"frame\": 6", "\"frame\": 4", "order them by frame"),
        ("\"switch\": true, ", "", "cannot be interpolated to 1 points"),
        ("\"dz_radii\": 4", "\"dz_radii\": 0", "keyframe 0 (frame 0): camera distance is 0"),
        ("\"dz_radii\": 4", "\"dz\": 4", "unknown field `dz`"),
        ("\"width\": 0.01", "\"width\": 0", "width is 0"),
        ("\"opacity\": 0.5", "\"opacity\": 1.5", "opacity must lie in [0, 1]"),
        ("\"lobes\"", "\"spheres\"", "unknown variant `spheres`"),
        (
            "{\"frame\": 10, \"camera\": {\"rx_deg\": 50, \"ry_deg\": -100, \"dz_radii\": 1}}",
            "{\"frame\": 10}",
            "neither camera nor transfer",
        ),
        ("\"frames\": 11,", "\"frames\": 11, \"fov_y_deg\": 200,", "field of view is 200"),
        ("\"dz_radii\": 4", "\"dz_radii\": 4, \"parallel_scale\": 0", "(frame 0): parallel scale is 0 "),
        ("\"frames\": 11,", "\"frames\": 11, \"speed\": 2,", "unknown field `speed`"),
    ] {
        let message = wrong(from, to);
        assert!(message.contains(expected), "{to}: {message}");
    }
    let cut = PathFile::parse(&GOOD[..GOOD.len() - 4]).unwrap_err().to_string();
    assert!(cut.contains("line 10"), "{cut}");
    let empty = r#"{"format": "entire-path-1", "frames": 3, "keyframes": []}"#;
    assert!(PathFile::parse(empty).unwrap().resolve().unwrap_err().to_string().contains("no keyframe"));
    let missing = FlightPath::open(Path::new("/no/such/path.json")).unwrap_err().to_string();
    assert!(missing.contains("cannot read the path"), "{missing}");
}

#[test]
fn generated_paths_fit_any_volume() {
    let ramp: Vec<u8> = (0..1000u32).map(|i| (i / 4) as u8).collect();
    let constant = [7u8; 1000];
    for data in [&ramp[..], &constant[..]] {
        let view = VolumeView::new(Scalars::U8(data), [10, 10, 10]).unwrap();
        for kind in
            [Generated::Switches, Generated::Orbit, Generated::Drag, Generated::FlyIn, Generated::Cuts]
        {
            for frames in [8, 120] {
                let file = kind.path(&view, frames).unwrap();
                let path = file.resolve().unwrap();
                assert_eq!(path.frames.len(), frames as usize);
                let switches = match kind {
                    Generated::Switches | Generated::Cuts => 3,
                    _ => 0,
                };
                assert_eq!(path.switches().len(), switches, "{}", kind.name());
                assert!(path.frames.iter().all(|f| f.transfer.lobes().unwrap().len() == 3));
            }
            assert!(kind.path(&view, 7).is_err());
        }
    }
}

#[test]
fn every_frame_between_extreme_keyframes_has_a_camera() {
    let key = |frame: usize, degrees: &str| {
        format!(
            "{{\"frame\": {frame}, \"camera\": {{\"rx_deg\": {degrees}, \"ry_deg\": 0, \"dz_radii\": 2}}, \
             \"transfer\": {{\"lobes\": [{{\"center\": {degrees}, \"width\": 0.1, \"height\": 0.5}}]}}}}"
        )
    };
    let text = format!(
        "{{\"format\": \"entire-path-1\", \"frames\": 5, \"keyframes\": [{}, {}]}}",
        key(0, "-3e38"),
        key(4, "3e38")
    );
    let path = PathFile::parse(&text).unwrap().resolve().unwrap();
    assert!((0..5).all(|i| path.camera(i).is_ok() && path.frames[i].transfer.function().to_table().is_ok()));
}

#[test]
fn long_paths_hold_no_transfer_function_twice() {
    let lobes = |height: f32| {
        let lobe = format!("{{\"center\": 0.5, \"width\": 0.1, \"height\": {height}}}");
        vec![lobe; MAX_TRANSFER_PARTS].join(",")
    };
    let text = |parts: &str| {
        format!(
            "{{\"format\": \"entire-path-1\", \"frames\": 1000000, \"keyframes\": \
             [{{\"frame\": 0, \"camera\": \
             {{\"rx_deg\": 0, \"ry_deg\": 0, \"dz_radii\": 2}}, \"transfer\": {{\"lobes\": [{parts}]}}}}]}}"
        )
    };
    let path = PathFile::parse(&text(&lobes(0.01))).unwrap().resolve().unwrap();
    assert_eq!(path.frames.len(), 1_000_000);
    // Frames share the keyframes' functions: a million functions of 1024 lobes each would take 12 GB.
    assert!(size_of::<PathFrame>() <= 64);
    assert!(Arc::ptr_eq(&path.frames[0].transfer.keys, &path.frames[999_999].transfer.keys));
    let too_many = format!("{}, {}", lobes(0.01), lobes(0.01));
    let said = format!("{:#}", PathFile::parse(&text(&too_many)).unwrap().resolve().unwrap_err());
    assert!(said.contains("2048 lobes; a transfer function has at most 1024"), "{said}");
}
