//! `entire render`: render one frame and time it.

use anyhow::{Context, Result, ensure};
use entire_core::scene::{Arcball, DEFAULT_FOV_Y_DEGREES, Frame, GaussianLobe, TransferFunction};
use entire_io::files::{ensure_not_input, make_folder_of, note, numbers_in, parse_numbers, write_whole};
use entire_io::metrics::median;
use entire_io::options::{RenderArgs, open_renderer, parse_size};
use entire_io::path::camera;
use entire_io::volume::{Reading, open_volume};
use entire_report::encode_png;
use entire_vk_raycaster::Rendered;
use serde_json::json;
use std::path::PathBuf;

/// Render one frame and time it.
///
/// Writes the picture, blended over black, as PNG (8-bit RGB), and prints its time on a line. With --json,
/// prints a JSON object instead: the seconds of every repeat, the number of samples (null if the renderer
/// does not count them), the device, the step and other settings.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire render data/mr_banana.nrrd --camera 20,35,2.5 --tf 0.4,0.01,0.6 \\
      --size 512x512 --out banana.png
  entire render ct.nii.gz --camera -10,120,3 --tf 0.2,0.002,0.1,0.7,0.01,0.8 \\
      --size 1280x720 --step 2 --shade local --skip distance \\
      --device vulkan --repeats 5 --out ct.png --json")]
pub(crate) struct Options {
    /// Volume file: .nrrd, .nhdr, .mhd, .mha, .vti, .nii, .nii.gz, .json, .raw or .raw.gz.
    pub(crate) volume: PathBuf,
    /// Rotation about x and y in degrees, and the distance of the eye from the volume's center in radii of
    /// the bounding sphere.
    #[arg(long, value_name = "RX,RY,DZ", value_parser = parse_camera, allow_hyphen_values = true)]
    pub(crate) camera: Arcball,
    /// Opacity lobes O(s) = Σ h·exp(−(s − c)²/w): center c, width w and height h of each lobe, for scalars s
    /// mapped to [0, 1].
    #[arg(long, value_name = "c,w,h[,c,w,h…]", value_parser = parse_lobes, allow_hyphen_values = true)]
    pub(crate) tf: Lobes,
    /// Image size in pixels.
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub(crate) size: (u32, u32),
    /// Ray step in reference steps (the smallest voxel spacing).
    #[arg(long, default_value_t = 1.0, value_name = "S", allow_hyphen_values = true)]
    pub(crate) step: f32,
    /// Rendering options.
    #[command(flatten)]
    pub(crate) render: RenderArgs,
    /// Vertical field of view in degrees.
    #[arg(long, default_value_t = DEFAULT_FOV_Y_DEGREES, value_name = "DEGREES", allow_hyphen_values = true)]
    pub(crate) fov: f32,
    /// Use a parallel (orthographic) projection; the value is half of the visible height, in radii of the
    /// bounding sphere.
    #[arg(long, value_name = "RADII", conflicts_with = "fov", allow_hyphen_values = true)]
    pub(crate) parallel_scale: Option<f32>,
    /// Options for reading the volume.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Number of timed renderings of the frame.
    #[arg(
        long,
        default_value_t = 1,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=100_000)
    )]
    pub(crate) repeats: u32,
    /// The picture to write.
    #[arg(long, value_name = "IMG.png")]
    pub(crate) out: PathBuf,
    /// Print a JSON object instead of a line.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Lobes(Vec<GaussianLobe>);

fn parse_camera(text: &str) -> Result<Arcball, String> {
    let [rx, ry, dz] = parse_numbers(text)?;
    Ok(Arcball { rx, ry, dz })
}

fn parse_lobes(text: &str) -> Result<Lobes, String> {
    let numbers = numbers_in(text)?;
    if !numbers.len().is_multiple_of(3) {
        return Err(format!(
            "{} numbers were given; each lobe needs three: center, width, height",
            numbers.len()
        ));
    }
    let lobes = numbers.as_chunks::<3>().0;
    Ok(Lobes(lobes.iter().map(|&[center, width, height]| GaussianLobe { center, width, height }).collect()))
}

pub(crate) fn run(options: &Options) -> Result<()> {
    // All options are checked before the volume is loaded.
    ensure_not_input(&options.out, [options.volume.as_path()]).context("--out")?;
    ensure!(
        options.out.extension().is_none_or(|e| e.eq_ignore_ascii_case("png")),
        "--out is {}; the picture is written as PNG: give a name that ends in .png",
        options.out.display()
    );
    make_folder_of(&options.out)?;
    let camera = camera(options.camera, options.fov, options.parallel_scale)?;
    let frame = Frame {
        step: options.step,
        termination: options.render.termination,
        shading: options.render.shade,
        skipping: options.render.skip,
        ..Frame::new(camera, options.size.0, options.size.1)?
    }
    .checked()?;
    let table = TransferFunction::Gaussian(options.tf.0.clone()).to_table()?;
    let volume = open_volume(&options.volume, &options.reading)?;
    let mut renderer = open_renderer(options.render.device)?;
    let view = volume.view();
    let volume_time = renderer.set_volume(&view).with_context(|| format!("{}", options.volume.display()))?;
    let table_time = renderer.set_transfer(&table)?;
    // The first rendering is not timed: it creates resources that later renderings reuse.
    let mut rendered = renderer.render(&frame)?;
    let mut repeats = Vec::new();
    for _ in 0..options.repeats {
        // Two pictures at once would take a gigabyte more at the largest size.
        drop(rendered);
        rendered = renderer.render(&frame)?;
        repeats.push(rendered.time);
    }
    let Rendered { image, mut counts, .. } = rendered;
    if counts.is_none() {
        // This renderer counts work only on request, so the frame is rendered once more, without timing.
        renderer.count_work(true);
        counts = renderer.render(&frame)?.counts;
    }
    // Premultiplied colors are already blended over black.
    write_whole(&options.out, &encode_png(&image)?)?;

    if counts.is_some_and(|c| c.samples == 0) {
        let (low, high) = view.range();
        note(&format!(
            "nothing is visible: the transfer function has no opacity at the volume's scalars (position 0 is \
             the scalar {low}, position 1 is {high}), or the camera does not see the volume"
        ));
    }
    let seconds: Vec<f64> = repeats.iter().map(|time| time.seconds()).collect();
    let clock = repeats.first().map_or("wall", |time| time.source());
    let median = median(&mut seconds.clone()).unwrap_or(f64::NAN);
    if options.json {
        let range = view.range();
        let json = json!({
            "volume": options.volume.to_string_lossy(),
            "dims": view.shape().dims,
            "scalar_type": view.scalars().scalar_type().to_string(),
            "range": [short(range.0), short(range.1)],
            "camera": {
                "rx_deg": short(options.camera.rx),
                "ry_deg": short(options.camera.ry),
                "dz_radii": short(options.camera.dz),
                "fov_y_deg": options.parallel_scale.is_none().then(|| short(options.fov)),
                "parallel_scale": options.parallel_scale.map(short),
            },
            "tf": options.tf.0.iter().map(|l| [l.center, l.width, l.height].map(short)).collect::<Vec<_>>(),
            "width": image.width,
            "height": image.height,
            "step": short(frame.step),
            "shade": options.render.shade.to_string(),
            "skip": options.render.skip.to_string(),
            "termination": short(frame.termination),
            "backend": renderer.backend(),
            "device": renderer.device(),
            "clock": clock,
            "seconds": seconds,
            "seconds_median": median,
            "seconds_wall": repeats.iter().map(|time| time.wall).collect::<Vec<_>>(),
            "seconds_cpu": repeats.iter().map(|time| time.cpu).collect::<Vec<_>>(),
            "seconds_prepare_volume": volume_time.wall,
            "seconds_prepare_transfer": table_time.wall,
            "seconds_upload": volume_time.upload,
            "seconds_block_map": volume_time.block_map,
            "seconds_occupancy": table_time.occupancy,
            "seconds_distance_map": table_time.distance_map,
            "samples": counts.map(|c| c.samples),
            "skips": counts.map(|c| c.skips),
            "rays": counts.map(|c| c.rays),
            "shaded": counts.map(|c| c.shaded),
            "out": options.out.to_string_lossy(),
        });
        println!("{json}");
    } else {
        let samples = counts.map_or_else(String::new, |c| format!(", {} samples", c.samples));
        let of = if seconds.len() > 1 { format!(", median of {}", seconds.len()) } else { String::new() };
        println!(
            "{:.3} ms ({clock} time{of}){samples} on {}; wrote {}",
            median * 1e3,
            renderer.device(),
            options.out.display()
        );
    }
    Ok(())
}

/// Returns the double that is nearest to the shortest decimal text of `value`, for JSON: 0.35, not
/// 0.3499999940395355.
fn short(value: f32) -> f64 {
    value.to_string().parse().unwrap_or(f64::from(value))
}
