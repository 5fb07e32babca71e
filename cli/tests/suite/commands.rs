//! `render`, `predict`, `encode` and `probe` as other programs call them.

use crate::support::*;
use std::io::Write;
use std::process::{Command, Stdio};

fn selu(x: f64) -> f64 {
    let (scale, alpha) = (1.0507009873554805, 1.6732632423543772);
    if x > 0.0 { scale * x } else { scale * alpha * x.exp_m1() }
}

fn tensor<'a>(tensors: &'a [Tensor<'_>], name: &str) -> &'a [f32] {
    &tensors.iter().find(|(n, ..)| *n == name).unwrap().2
}

/// The value of a line like `1.23456789e-3`, which must have 9 significant digits.
fn nine_digits(word: &str) -> f64 {
    let mantissa = word.trim_start_matches('-').split('e').next().unwrap();
    assert_eq!(mantissa.chars().filter(char::is_ascii_digit).count(), 9, "{word}");
    word.parse().unwrap()
}

#[test]
fn predict_prints_a_line_per_row_that_agrees_with_double_precision() {
    let folder = workshop();
    let net = prednet();
    let (w0, b0) = (tensor(&net, "prednet.0.weight"), tensor(&net, "prednet.0.bias"));
    let (w1, b1) = (tensor(&net, "prednet.1.weight"), tensor(&net, "prednet.1.bias"));
    let (mean, std) = (tensor(&net, "prednet.input.mean"), tensor(&net, "prednet.input.std"));
    let table = std::fs::read_to_string(folder.path().join("rows.csv")).unwrap();
    let printed =
        succeeds(folder.path(), &["predict", "--model", "pred.safetensors", "--inputs", "rows.csv"]);
    assert_eq!(printed.lines().count(), 7);
    for (line, row) in printed.lines().zip(table.lines()) {
        let x: Vec<f64> = row
            .split(',')
            .enumerate()
            .map(|(i, v)| (v.parse::<f64>().unwrap() - f64::from(mean[i])) / f64::from(std[i]))
            .collect();
        let mut y = f64::from(b1[0]);
        for unit in 0..4 {
            let sum: f64 = (0..5).map(|i| f64::from(w0[unit * 5 + i]) * x[i]).sum();
            y += f64::from(w1[unit]) * selu(sum + f64::from(b0[unit]));
        }
        let found = nine_digits(line);
        assert!((found - y).abs() <= 2e-5 * y.abs(), "{found} {y}");
    }
    let packed = entire_io::files::gzip(table.as_bytes()).unwrap();
    std::fs::write(folder.path().join("rows.csv.gz"), packed).unwrap();
    let line = "predict --model pred.safetensors --inputs rows.csv.gz";
    assert_eq!(succeeds(folder.path(), &words(line)), printed);
}

#[test]
fn predict_reads_standard_input_with_blanks_and_other_line_ends() {
    let folder = workshop();
    let table = std::fs::read_to_string(folder.path().join("rows.csv")).unwrap();
    let expected =
        succeeds(folder.path(), &["predict", "--model", "pred.safetensors", "--inputs", "rows.csv"]);
    let mut child = Command::new(env!("CARGO_BIN_EXE_entire"))
        .args(words("predict --model pred.safetensors --inputs -"))
        .current_dir(folder.path())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let other = table.replace(',', " , ").replace('\n', "\r\n");
    child.stdin.take().unwrap().write_all(other.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    assert_eq!(stdout(&output), expected);
}

#[test]
fn encode_prints_features_that_agree_with_double_precision() {
    let folder = workshop();
    // 4³ voxels, so that nothing is resampled; range -1…7.
    let values: Vec<f32> = (0..64).map(|i| ((i * 37) % 9) as f32 - 1.0).collect();
    std::fs::write(folder.path().join("v.nrrd"), float_nrrd([4, 4, 4], values.iter().copied())).unwrap();
    let net = volumenet();
    let t = |name: &str| tensor(&net, name).iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
    let (weight, bias) = (t("volumenet.encoder.0.conv.weight"), t("volumenet.encoder.0.conv.bias"));
    let (gamma, beta) = (t("volumenet.encoder.0.bn.weight"), t("volumenet.encoder.0.bn.bias"));
    let (mean, var) = (t("volumenet.encoder.0.bn.running_mean"), t("volumenet.encoder.0.bn.running_var"));
    let (fc, fc_bias) = (t("volumenet.fc.weight"), t("volumenet.fc.bias"));
    let features = |low: f64, high: f64| -> Vec<f64> {
        let input: Vec<f64> = values
            .iter()
            .map(|&v| 2.0 * ((f64::from(v) - low) / (high - low)).clamp(0.0, 1.0) - 1.0)
            .collect();
        let mut flat = Vec::new();
        for channel in 0..2 {
            for block in 0..8 {
                let (bx, by, bz) = (block % 2, block / 2 % 2, block / 4);
                let mut sum = bias[channel];
                for k in 0..8 {
                    let (x, y, z) = (2 * bx + k % 2, 2 * by + k / 2 % 2, 2 * bz + k / 4);
                    sum += weight[channel * 8 + k] * input[x + 4 * y + 16 * z];
                }
                let normal =
                    (sum - mean[channel]) / (var[channel] + 1e-5).sqrt() * gamma[channel] + beta[channel];
                flat.push(selu(normal));
            }
        }
        (0..2).map(|f| fc_bias[f] + (0..16).map(|i| fc[f * 16 + i] * flat[i]).sum::<f64>()).collect()
    };
    for (range, expected) in [(None, features(-1.0, 7.0)), (Some("-3,5"), features(-3.0, 5.0))] {
        let mut arguments = vec!["encode", "--model", "volume.safetensors", "v.nrrd"];
        arguments.extend(range.iter().flat_map(|r| ["--range", r]));
        let printed = succeeds(folder.path(), &arguments);
        assert_eq!(printed.lines().count(), 1);
        let found: Vec<f64> = printed.trim_end().split(',').map(nine_digits).collect();
        assert_eq!(found.len(), 2);
        let norm = expected.iter().map(|v| v * v).sum::<f64>().sqrt();
        for (found, expected) in found.iter().zip(&expected) {
            assert!((found - expected).abs() < 1e-4 * norm, "{found} {expected}");
        }
    }
    let [one, two] = ["1", "2"].map(|threads| {
        let line = format!("encode --model volume.safetensors ball.nrrd --threads {threads}");
        succeeds(folder.path(), &words(&line))
    });
    assert_eq!(one, two);
}

#[test]
fn render_writes_a_picture_and_tells_what_it_took() {
    let folder = workshop();
    let tf = "0.3,0.02,0.4,0.9,0.01,0.8";
    let arguments = render(
        "ball.nrrd",
        "-20,35,2.5",
        tf,
        "40x30",
        &["--repeats", "3", "--step", "0.5", "--shade", "local", "--json"],
    );
    let printed = succeeds(folder.path(), &arguments);
    assert_eq!(printed.lines().count(), 1);
    let json: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let seconds = json["seconds"].as_array().unwrap();
    assert_eq!(seconds.len(), 3);
    assert!(seconds.iter().all(|s| s.as_f64().unwrap() > 0.0));
    assert!(json["seconds_upload"].as_f64().unwrap() > 0.0);
    assert!(json["seconds_distance_map"].as_f64().unwrap() > 0.0);
    assert!(json["samples"].as_u64().unwrap() > 1000);
    assert_eq!(json["step"], 0.5);
    assert_eq!((json["shade"].as_str(), json["skip"].as_str()), (Some("local"), Some("blocks")));
    assert_eq!(json["backend"], "cpu");
    assert!(!json["device"].as_str().unwrap().is_empty());
    assert_eq!(json["dims"], serde_json::json!([12, 10, 16]));
    let (width, height, rgb) = picture(&folder.path().join("out.png"));
    assert_eq!((width, height), (40, 30));
    // The ball is in the middle and the corners are black.
    assert!(rgb[(15 * 40 + 20) * 3..][..3].iter().any(|&v| v > 20));
    assert_eq!(&rgb[..3], &[0, 0, 0]);

    let line = succeeds(folder.path(), &render("ball.nrrd", "0,0,2.5", tf, "40x30", &[]));
    assert!(line.contains(" ms (") && line.contains("wrote out.png"), "{line}");
}

#[test]
fn render_draws_parallel_rays_whatever_the_distance() {
    let folder = workshop();
    let draw = |camera: &str, more: &[&str]| {
        let arguments = render("ball.nrrd", camera, "0.3,0.02,0.4,0.9,0.01,0.8", "40x30", more);
        let printed = succeeds(folder.path(), &arguments);
        let json: serde_json::Value = serde_json::from_str(&printed).unwrap();
        (json, picture(&folder.path().join("out.png")).2)
    };
    let lit = |rgb: &[u8]| rgb.chunks(3).filter(|p| p.iter().any(|&v| v > 4)).count() as f64;
    let (near, seen) = draw("-20,35,2", &["--json", "--parallel-scale", "1.1"]);
    let (far, same) = draw("-20,35,900", &["--json", "--parallel-scale", "1.1"]);
    assert_eq!((&near["samples"], &seen), (&far["samples"], &same));
    assert_eq!(near["camera"]["parallel_scale"], 1.1);
    assert!(near["camera"]["fov_y_deg"].is_null());
    // Half the scale shows everything twice as wide and high.
    let (_, close) = draw("-20,35,2", &["--json", "--parallel-scale", "0.55"]);
    let ratio = lit(&close) / lit(&seen);
    assert!((3.2..4.8).contains(&ratio), "{ratio}");
    let (lens, other) = draw("-20,35,2", &["--json"]);
    assert!(other != seen && lens["camera"]["parallel_scale"].is_null());
    refuses(
        folder.path(),
        &render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "8x8", &["--parallel-scale", "0"]),
        &["parallel scale is 0", "1e-6"],
    );
}

#[test]
fn render_skips_without_changing_the_picture_and_range_changes_it() {
    let folder = workshop();
    let mut pictures = Vec::new();
    for more in [["--skip", "none"], ["--skip", "blocks"], ["--skip", "distance"], ["--range", "-1,1"]] {
        succeeds(folder.path(), &render("ball.nrrd", "10,20,2", "0.8,0.005,0.5", "32x32", &more));
        pictures.push(picture(&folder.path().join("out.png")));
    }
    assert_eq!(pictures[0], pictures[1]);
    assert_eq!(pictures[0], pictures[2]);
    assert_ne!(pictures[0], pictures[3]);
}

#[test]
fn probe_prints_the_machine_in_five_numbers() {
    let folder = workshop();
    let printed = probed(folder.path(), "cpu", true);
    let json: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let numbers = json["numbers"].as_object().unwrap();
    assert_eq!(numbers.len(), 5);
    assert!(numbers.values().all(|v| v.as_f64().unwrap() > 0.0), "{printed}");
    assert_eq!(json["agreement"]["largest_of_255"], 0);
    assert_eq!(json["agreement"]["counts"], json["agreement"]["counts_of_twin"]);
    assert_eq!((json["backend"].as_str(), json["clock"].as_str()), (Some("cpu"), Some("wall")));
    let text = probed(folder.path(), "cpu", false);
    for part in
        ["counts equal", "coherent samples", "divergent samples", "skips", "rays", "fixed time per frame"]
    {
        assert!(text.contains(part), "{text}");
    }
    for bad in ["0", "-1", "fast", "1e9"] {
        let output = entire(folder.path(), &["probe", "--frame-ms", bad]);
        assert_eq!(output.status.code(), Some(2), "{bad}");
    }
}

#[test]
fn every_volume_format_renders_the_same_picture() {
    let folder = workshop();
    let mut pictures = Vec::new();
    for name in words(
        "pynrrd_gzip_int16_little.nrrd pynrrd_detached_int16_little.nhdr itk_msb_int16_big.mha \
         vtk_binary-zlib_int16_little.vti nibabel_gz_int16_little.nii.gz raw_5x7x11_int16_big.raw \
         raw_5x7x11_int16_little.json",
    ) {
        let path = fixture(name);
        succeeds(folder.path(), &render(path.to_str().unwrap(), "30,50,2", "0.5,0.2,0.3", "24x24", &[]));
        pictures.push(picture(&folder.path().join("out.png")));
    }
    assert!(pictures[0].2.iter().any(|&v| v > 20));
    assert!(pictures.iter().all(|p| *p == pictures[0]));
}

#[test]
fn a_closed_pipe_is_no_error() {
    let folder = workshop();
    let many: String = std::fs::read_to_string(folder.path().join("rows.csv")).unwrap().repeat(20_000);
    std::fs::write(folder.path().join("many.csv"), many).unwrap();
    let output = unread(folder.path(), "predict --model pred.safetensors --inputs many.csv");
    assert!(output.stderr.is_empty(), "{}", stderr(&output));
}

#[test]
#[cfg(target_os = "linux")]
fn output_that_cannot_be_written_is_an_error() {
    let folder = workshop();
    for line in [
        "doctor",
        "predict --model pred.safetensors --inputs rows.csv",
        "encode --model volume.safetensors ball.nrrd",
        "render ball.nrrd --camera 0,0,2 --tf 0.5,0.1,0.5 --size 8x8 --out o.png --device cpu",
    ] {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_entire"));
        let output = command.args(words(line)).current_dir(folder.path()).stdout(full).output().unwrap();
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{line}: {said}");
        assert!(said.contains("cannot write to stdout: No space"), "{line}: {said}");
    }
}

#[test]
fn wrong_usage_exits_with_2_and_help_shows_examples() {
    let folder = workshop();
    let camera =
        ["render", "ball.nrrd", "--tf", "0.5,0.1,0.5", "--size", "8x8", "--out", "o.png", "--camera"];
    for arguments in [
        vec![],
        vec!["nonsense"],
        vec!["render", "ball.nrrd"],
        vec!["predict", "--model", "pred.safetensors"],
        vec!["encode", "--model", "volume.safetensors"],
        [camera.as_slice(), &["1,2"]].concat(),
        [camera.as_slice(), &["1,2,x"]].concat(),
        [camera.as_slice(), &["1,2,3", "--shade", "pretty"]].concat(),
        [camera.as_slice(), &["1,2,3", "--repeats", "0"]].concat(),
        render("ball.nrrd", "0,0,2", "0.5,0.1", "8x8", &[]),
        render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "8", &[]),
        render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "8x-8", &[]),
        render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "0x8", &[]),
        render("ball.nrrd", "0,0,2", "0.5,0.1,0.5", "8x100000", &[]),
    ] {
        let output = entire(folder.path(), &arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", stderr(&output));
        assert!(!stderr(&output).contains("panicked"));
    }
    for command in
        words("calibrate collect features train evaluate predict encode render probe steer schedule demo")
    {
        let help = succeeds(folder.path(), &[command, "--help"]);
        assert!(help.contains("Examples:") && help.contains(&format!("entire {command}")), "{help}");
    }
    assert!(succeeds(folder.path(), &["--version"]).starts_with("entire "));
}

/// A software device distributes rows of workgroups over its threads. With any number of threads, each row
/// must be drawn once.
#[test]
fn pictures_do_not_depend_on_the_number_of_threads() {
    let folder = workshop();
    for size in ["61x83", "40x17", "8x8", "33x120"] {
        let line = format!("render ball.nrrd --camera 10,20,2.2 --tf 0.7,0.2,0.5 --size {size} --out a.png");
        let drawn = |threads: &str| {
            let output = entire_in(folder.path(), &[("LP_NUM_THREADS", threads)], &words(&line));
            assert!(output.status.success(), "{}", stderr(&output));
            picture(&folder.path().join("a.png"))
        };
        let one = drawn("1");
        assert!(one.2.iter().any(|v| *v > 0), "the picture is black");
        for threads in ["2", "3", "5", "16"] {
            assert!(drawn(threads) == one, "{size}, {threads} threads");
        }
    }
}
