//! Bad input: every command ends with status 1 and one line with cause and remedy, or with the defined result
//! for input that is merely extreme.

use crate::support::*;

const TF: &str = "0.5,0.1,0.5";

#[test]
fn missing_and_truncated_files() {
    let folder = workshop();
    let at = folder.path();
    for (arguments, parts) in [
        (render("gone.nrrd", "0,0,2", TF, "8x8", &[]), ["gone.nrrd", "no such file"]),
        (words("encode --model gone.safetensors ball.nrrd"), ["gone.safetensors", "no such file"]),
        (words("encode --model volume.safetensors gone.mha"), ["gone.mha", "no such file"]),
        (words("predict --model gone.safetensors --inputs rows.csv"), ["gone.safetensors", "no such file"]),
        (words("predict --model pred.safetensors --inputs gone.csv"), ["gone.csv", "no such file"]),
        (words("predict --model . --inputs rows.csv"), [".", "is a folder"]),
        (render("rows.csv", "0,0,2", TF, "8x8", &[]), ["rows.csv", "accepted are .nrrd"]),
    ] {
        refuses(at, &arguments, &parts);
    }
    for name in ["ball.nrrd", "pred.safetensors", "volume.safetensors", "rows.csv"] {
        let whole = std::fs::read(at.join(name)).unwrap();
        for keep in [whole.len() - 1, whole.len() / 2, 60, 9, 1, 0] {
            std::fs::write(at.join(name), &whole[..keep]).unwrap();
            let rows = ["predict", "--model", "pred.safetensors", "--inputs", name];
            match name {
                "ball.nrrd" => refuses(at, &render(name, "0,0,2", TF, "8x8", &[]), &[name]),
                "pred.safetensors" => {
                    refuses(at, &["predict", "--model", name, "--inputs", "rows.csv"], &[name])
                }
                "volume.safetensors" => refuses(at, &["encode", "--model", name, "ball.nrrd"], &[name]),
                // A truncated table may lack rows or digits without being invalid.
                _ if keep == 0 => refuses(at, &rows, &[name, "no row"]),
                _ => assert!(matches!(entire(at, &rows).status.code(), Some(0 | 1))),
            }
        }
        std::fs::write(at.join(name), whole).unwrap();
    }
}

#[test]
fn tables_with_wrong_cells() {
    let folder = workshop();
    let at = folder.path();
    for (table, parts) in [
        ("1,2,3,4\n", vec!["row 1 has 4 columns, the model takes 5: camera 3, resolution 2"]),
        ("1,2,3,4,5\n1,2,3,4,5,6\n", vec!["row 2 has 6 columns"]),
        (
            "rx,ry,dz,w,h\n1,2,3,4,5\n",
            vec!["row 1, column 1: \"rx\" is not a number", "a header line is not"],
        ),
        ("1,2,3,4,5\n1,2,,4,5\n", vec!["row 2, column 3: \"\" is not a number"]),
        ("1,2,3,4,5\n1,2,3,nan,5\n", vec!["row 2, column 4: \"nan\" is not finite"]),
        ("1,2,3,4,-inf\n", vec!["row 1, column 5: \"-inf\" is not finite"]),
        ("1,2,3,4,1e39\n", vec!["row 1, column 5: \"1e39\" is not finite"]),
        ("1;2;3;4;5\n", vec!["row 1 has 1 column,"]),
        ("\u{0}\u{1}\u{7f}\n", vec!["row 1 has 1 column,"]),
        ("\n\n", vec!["holds no row"]),
    ] {
        std::fs::write(at.join("t.csv"), table).unwrap();
        let all = [&["t.csv"], &parts[..]].concat();
        refuses(at, &["predict", "--model", "pred.safetensors", "--inputs", "t.csv"], &all);
    }
    std::fs::write(at.join("t.csv"), b"1,2,\xff\xfe,4,5\n").unwrap();
    let predict = words("predict --model pred.safetensors --inputs t.csv");
    refuses(at, &predict, &["row 1, column 3", "not a number"]);
}

fn changed(
    tensors: Vec<Tensor<'static>>,
    name: &str,
    change: impl Fn(&mut Tensor<'static>),
) -> Vec<Tensor<'static>> {
    let mut tensors = tensors;
    change(tensors.iter_mut().find(|(n, ..)| *n == name).unwrap());
    tensors
}

#[test]
fn models_with_wrong_shapes_numbers_or_metadata() {
    let folder = workshop();
    let at = folder.path();
    let poke = |name: &str, value: f32| changed(prednet(), name, move |t| t.2[0] = value);
    let without = |name: &str| prednet().into_iter().filter(|(n, ..)| *n != name).collect::<Vec<_>>();
    let meta = |key: &str, value: &'static str| {
        PREDNET_METADATA.map(|(k, v)| if k == key { (k, value) } else { (k, v) })
    };
    for (metadata, tensors, parts) in [
        (PREDNET_METADATA, poke("prednet.0.weight", f32::NAN), vec!["prednet.0.weight", "NaN", "finite"]),
        (PREDNET_METADATA, poke("prednet.1.bias", f32::INFINITY), vec!["prednet.1.bias", "inf"]),
        (PREDNET_METADATA, poke("prednet.input.std", 0.0), vec!["prednet.input.std"]),
        (PREDNET_METADATA, without("prednet.0.bias"), vec!["prednet.0.bias"]),
        (PREDNET_METADATA, without("prednet.1.weight"), vec!["prednet"]),
        (
            PREDNET_METADATA,
            changed(prednet(), "prednet.1.weight", |t| (t.1, t.2) = (vec![1, 3], vec![0.0; 3])),
            vec!["prednet.1.weight", "4", "3"],
        ),
        (
            PREDNET_METADATA,
            changed(prednet(), "prednet.0.bias", |t| (t.1, t.2) = (vec![2], vec![0.0; 2])),
            vec!["prednet.0.bias"],
        ),
        (meta("entire.format", "2"), prednet(), vec!["entire.format", "\"2\""]),
        (meta("entire.target", "minutes"), prednet(), vec!["entire.target", "minutes"]),
        (meta("entire.inputs", "[]"), prednet(), vec!["entire.inputs"]),
        (meta("entire.inputs", "not json"), prednet(), vec!["entire.inputs"]),
        (
            meta("entire.inputs", r#"[{"name":"camera","size":4}]"#),
            prednet(),
            vec!["entire.inputs", "\"camera\" has size 4, expected 3"],
        ),
        (
            meta("entire.inputs", r#"[{"name":"camera","size":3},{"name":"mystery","size":3}]"#),
            prednet(),
            vec!["entire.inputs", "6", "5"],
        ),
    ] {
        std::fs::write(at.join("m.safetensors"), safetensors(&metadata, &tensors)).unwrap();
        let all = [&["m.safetensors"], &parts[..]].concat();
        refuses(at, &["predict", "--model", "m.safetensors", "--inputs", "rows.csv"], &all);
    }
    // The caller supplies the values of an unknown group: here, columns of the table.
    let unknown = meta("entire.inputs", r#"[{"name":"camera","size":3},{"name":"mystery","size":2}]"#);
    std::fs::write(at.join("m.safetensors"), safetensors(&unknown, &prednet())).unwrap();
    let printed = succeeds(at, &["predict", "--model", "m.safetensors", "--inputs", "rows.csv"]);
    assert_eq!(printed.lines().count(), 7);
    std::fs::write(at.join("t.csv"), "1,2,3\n").unwrap();
    refuses(at, &["predict", "--model", "m.safetensors", "--inputs", "t.csv"], &["camera 3, mystery 2"]);
    let log = meta("entire.target", "log_seconds");
    std::fs::write(at.join("m.safetensors"), safetensors(&log, &poke("prednet.1.bias", 100.0))).unwrap();
    let predict = ["predict", "--model", "m.safetensors", "--inputs", "rows.csv"];
    refuses(at, &predict, &["rows.csv: row 1: the model predicts inf seconds", "check the units"]);
    // Times below a microsecond, and below zero, become the shortest time.
    for (metadata, bias) in [(&log, -100.0), (&meta("entire.target", "seconds"), -1e6)] {
        std::fs::write(at.join("m.safetensors"), safetensors(metadata, &poke("prednet.1.bias", bias)))
            .unwrap();
        let printed = succeeds(at, &predict);
        assert!(
            printed.lines().count() == 7 && printed.lines().all(|line| line.parse() == Ok(1e-6f32)),
            "{printed}"
        );
    }
    let poke = |name: &str, value: f32| changed(volumenet(), name, move |t| t.2[0] = value);
    let twice = |edge: &'static str| [VOLUMENET_METADATA[0], ("entire.volumenet", edge)];
    for (metadata, tensors, parts) in [
        (VOLUMENET_METADATA, poke("volumenet.fc.weight", f32::NAN), vec!["volumenet.fc.weight", "NaN"]),
        (VOLUMENET_METADATA, poke("volumenet.encoder.0.bn.running_var", -1.0), vec!["running_var"]),
        (
            VOLUMENET_METADATA,
            poke("volumenet.encoder.0.conv.weight", f32::NEG_INFINITY),
            vec!["conv.weight", "inf"],
        ),
        (
            twice(r#"{"input":8,"blocks":[{"stride":2,"padding":0}]}"#),
            volumenet(),
            vec!["volumenet.fc.weight"],
        ),
        (twice(r#"{"input":0,"blocks":[{"stride":2,"padding":0}]}"#), volumenet(), vec!["entire.volumenet"]),
        (
            twice(r#"{"input":1000000,"blocks":[{"stride":2,"padding":0}]}"#),
            volumenet(),
            vec!["entire.volumenet"],
        ),
        (twice(r#"{"input":4,"blocks":[{"stride":0,"padding":0}]}"#), volumenet(), vec!["stride"]),
        (twice(r#"{"input":4,"blocks":[]}"#), volumenet(), vec!["volumenet"]),
        (
            VOLUMENET_METADATA,
            changed(volumenet(), "volumenet.encoder.0.conv.weight", |t| t.1 = vec![2, 1, 2, 4, 1]),
            vec!["volumenet.encoder.0.conv.weight"],
        ),
    ] {
        std::fs::write(at.join("m.safetensors"), safetensors(&metadata, &tensors)).unwrap();
        let all = [&["m.safetensors"], &parts[..]].concat();
        refuses(at, &["encode", "--model", "m.safetensors", "ball.nrrd"], &all);
    }
    for (line, parts) in [
        ("predict --model volume.safetensors --inputs rows.csv", &["volume.safetensors", "no PredNet"][..]),
        ("encode --model pred.safetensors ball.nrrd", &["pred.safetensors", "no VolumeNet"]),
        ("encode --model ball.nrrd ball.nrrd", &["ball.nrrd"]),
        ("encode --model volume.safetensors ball.nrrd --range 2,1", &["ball.nrrd", "range"]),
        ("encode --model volume.safetensors ball.nrrd --range nan,1", &["range"]),
    ] {
        refuses(at, &words(line), parts);
    }
}

#[test]
fn frames_that_cannot_be() {
    let folder = workshop();
    let frame = |camera: &'static str, more: &[&'static str]| render("ball.nrrd", camera, TF, "8x8", more);
    for (arguments, parts) in [
        (frame("0,0,0", &[]), vec!["camera distance is 0"]),
        (frame("0,0,-1", &[]), vec!["camera distance is -1"]),
        (frame("nan,0,2", &[]), vec!["camera angles", "NaN"]),
        (frame("0,inf,2", &[]), vec!["camera angles", "inf"]),
        (frame("0,0,2", &["--step", "0"]), vec!["ray step is 0"]),
        (frame("0,0,2", &["--step", "-2"]), vec!["ray step is -2"]),
        (frame("0,0,2", &["--step", "NaN"]), vec!["ray step is NaN"]),
        (frame("0,0,2", &["--termination", "0"]), vec!["termination opacity is 0"]),
        (frame("0,0,2", &["--fov", "180"]), vec!["field of view is 180"]),
        (render("ball.nrrd", "0,0,2", "0.5,0,0.5", "8x8", &[]), vec!["lobe 0", "width is 0"]),
        (render("ball.nrrd", "0,0,2", "0.5,0.1,0.5,nan,0.1,1", "8x8", &[]), vec!["lobe 1", "NaN"]),
        (render("ball.nrrd", "0,0,2", "0.5,0.1,-1", "8x8", &[]), vec!["lobe 0", "height is -1"]),
        (frame("0,0,2", &["--range", "1,0"]), vec!["range is 1…0"]),
        (frame("0,0,2", &["--out", "ball.nrrd"]), vec!["--out: ball.nrrd is an input"]),
        (frame("0,0,2", &["--out", "x.jpg"]), vec!["--out is x.jpg", ".png"]),
    ] {
        refuses(folder.path(), &arguments, &parts);
    }
}

/// Returns the pixels of a volume under a transfer function; the run must succeed.
fn pixels(at: &std::path::Path, volume: &str, camera: &str, tf: &str, size: &str, more: &[&str]) -> Vec<u8> {
    succeeds(at, &render(volume, camera, tf, size, more));
    picture(&at.join("out.png")).2
}

#[test]
fn extreme_transfer_functions_cameras_and_sizes_render() {
    let folder = workshop();
    let at = folder.path();
    for shade in ["none", "local", "scatter"] {
        for skip in ["none", "blocks", "distance"] {
            let more = ["--shade", shade, "--skip", skip];
            // Fully transparent: black.
            assert!(pixels(at, "ball.nrrd", "0,0,2", "0.5,0.1,0", "16x16", &more).iter().all(|&v| v == 0));
            // Fully opaque: only the front of the box is seen.
            let opaque = pixels(at, "ball.nrrd", "0,0,2", "0.5,1e9,1", "16x16", &more);
            assert!(opaque[(8 * 16 + 8) * 3..][..3].iter().any(|&v| v > 10), "{shade} {skip}");
            // The camera inside the volume, and almost at its center.
            assert!(pixels(at, "ball.nrrd", "0,0,0.3", TF, "16x16", &more).iter().any(|&v| v > 10));
            assert!(pixels(at, "ball.nrrd", "0,0,1e-6", TF, "16x16", &more).iter().any(|&v| v > 10));
            // One pixel.
            assert_eq!(pixels(at, "ball.nrrd", "0,0,2", TF, "1x1", &more).len(), 3);
        }
    }
    // The camera is so far away that no ray hits the volume.
    assert!(pixels(at, "ball.nrrd", "0,0,1e6", TF, "16x16", &[]).iter().all(|&v| v == 0));
    assert!(pixels(at, "ball.nrrd", "-720,36000,2", TF, "16x16", &[]).iter().any(|&v| v > 10));
    assert_eq!(pixels(at, "ball.nrrd", "0,0,2", TF, "1x64", &["--step", "4096"]).len(), 64 * 3);
}

#[test]
fn volumes_with_broken_constant_or_thin_voxels_have_an_answer() {
    let folder = workshop();
    let at = folder.path();
    let put = |name: &str, bytes: &[u8]| std::fs::write(at.join(name), bytes).unwrap();
    let number = |text: String| text.trim().split(',').map(|w| w.parse::<f64>().unwrap()).collect::<Vec<_>>();
    put("zero.nrrd", &float_nrrd([4, 0, 4], std::iter::empty()));
    refuses(at, &render("zero.nrrd", "0,0,2", TF, "8x8", &[]), &["zero.nrrd", "size along y is 0"]);
    let encode = words("encode --model volume.safetensors zero.nrrd");
    refuses(at, &encode, &["zero.nrrd", "size along y is 0"]);

    // NaN counts as the low end and the infinities as the ends of the finite range; a note says so.
    let clean = |i: usize| [0.0, 1.0, 0.5][i % 3];
    let dirty = |i: usize| match i {
        3 => f32::NAN,
        4 => f32::INFINITY,
        6 => f32::NEG_INFINITY,
        _ => clean(i),
    };
    put("clean.nrrd", &float_nrrd([4, 5, 6], (0..120).map(clean)));
    put("dirty.nrrd", &float_nrrd([4, 5, 6], (0..120).map(dirty)));
    let output = entire(at, &render("dirty.nrrd", "20,30,2", TF, "16x16", &[]));
    assert_eq!(output.status.code(), Some(0));
    assert!(
        stderr(&output).contains("note: dirty.nrrd: 3 of 120 voxels are NaN or infinite"),
        "{}",
        stderr(&output)
    );
    let dirty = picture(&at.join("out.png"));
    assert_eq!(dirty.2, pixels(at, "clean.nrrd", "20,30,2", TF, "16x16", &[]));
    let encode = |name: &str| number(succeeds(at, &["encode", "--model", "volume.safetensors", name]));
    assert_eq!(encode("dirty.nrrd"), encode("clean.nrrd"));

    // A volume without finite values is drawn and encoded as the low end everywhere.
    put("nan.nrrd", &float_nrrd([4, 4, 4], (0..64).map(|_| f32::NAN)));
    put("same.nrrd", &float_nrrd([4, 4, 4], (0..64).map(|_| 7.0)));
    assert_eq!(encode("nan.nrrd"), encode("same.nrrd"));
    assert!(encode("nan.nrrd").iter().all(|f| f.is_finite()));
    for name in ["nan.nrrd", "same.nrrd"] {
        assert!(pixels(at, name, "0,0,2", "0.9,0.01,1", "16x16", &[]).iter().all(|&v| v == 0));
        assert!(pixels(at, name, "0,0,2", "0,0.01,1", "16x16", &[]).iter().any(|&v| v > 10));
    }

    // One voxel thick along each axis, a line, and a single voxel.
    for dims in [[1, 8, 8], [8, 1, 8], [8, 8, 1], [1, 1, 8], [1, 1, 1]] {
        put("thin.nrrd", &float_nrrd(dims, (0..dims.iter().product()).map(|i| i as f32)));
        assert!(encode("thin.nrrd").iter().all(|f| f.is_finite()));
        for shade in ["none", "local", "scatter"] {
            let more = ["--shade", shade, "--skip", "distance"];
            let rgb = pixels(at, "thin.nrrd", "35,35,2", "0.5,1,1", "32x32", &more);
            assert!(rgb.iter().any(|&v| v > 10), "{dims:?} {shade}");
        }
    }
}

#[test]
fn settings_of_the_environment_are_not_replaced() {
    let folder = workshop();
    let arguments =
        ["render", "ball.nrrd", "--camera", "0,0,2", "--tf", TF, "--size", "8x8", "--out", "o.png"];
    for (name, value) in [("ENTIRE_TILE", "3"), ("ENTIRE_DEVICE", "no such device"), ("ENTIRE_LEVEL", "fast")]
    {
        refuses_in(folder.path(), &[(name, value)], &arguments, &[value]);
        assert!(!folder.path().join("o.png").exists(), "{name}");
    }
}

#[test]
fn a_picture_of_nothing_is_no_silence() {
    let folder = workshop();
    let arguments = render("ball.nrrd", "0,0,2", "4,0.01,0.5", "8x8", &[]);
    let output = entire(folder.path(), &arguments);
    assert!(output.status.success() && stderr(&output).contains("nothing is visible"), "{output:?}");
}

#[test]
fn files_that_cannot_be_written_are_named() {
    let folder = workshop();
    let at = folder.path();
    std::fs::write(at.join("file"), "x").unwrap();
    let refused = "cannot make the folder file:";
    for arguments in [
        words("collect ball.nrrd --frames 4 --device cpu --out file/u.csv"),
        render("ball.nrrd", "0,0,2", TF, "8x8", &["--out", "file/o.png"]),
        words("train --data t.csv --out file/m.safetensors"),
    ] {
        refuses(at, &arguments, &[refused]);
    }
    assert_eq!(std::fs::read(at.join("file")).unwrap(), b"x");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let locked = at.join("locked");
        std::fs::create_dir(&locked).unwrap();
        std::fs::set_permissions(&locked, std::fs::Permissions::from_mode(0o555)).unwrap();
        // The superuser may write to this folder, so the refusal cannot be tested.
        if std::fs::write(locked.join("probe"), "").is_ok() {
            return;
        }
        for arguments in [
            words("collect ball.nrrd --frames 4 --device cpu --out locked/u.csv"),
            render("ball.nrrd", "0,0,2", TF, "8x8", &["--out", "locked/o.png"]),
        ] {
            refuses(at, &arguments, &["cannot write locked/"]);
        }
        assert_eq!(std::fs::read_dir(&locked).unwrap().count(), 0);
    }
}
