//! Times frames of one scene: `time_frames [key=value]…`
//!
//! volume=noise|vessels|FILE (raw bytes, with dims=XxYxZ)  n=256  tf=transparent|medium|opaque|scan
//! size=512  step=1  shade=none|local|scatter  skip=none|blocks|distance  device=vulkan|cpu
//! fetch=sampler|texels|packed  repeat=10  rx=20 ry=30 dz=3.8637  termination=0.99  out=IMAGE.png

mod common;

use entire_core::scene::{Arcball, Camera, Frame, Scalars, Shading, Skipping, VolumeView};
use entire_vk_raycaster::{CpuRaycaster, Renderer, VoxelFetch, VulkanOptions, VulkanRaycaster};
use std::collections::HashMap;
use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    let given: HashMap<String, String> = std::env::args()
        .skip(1)
        .filter_map(|a| a.split_once('=').map(|(k, v)| (k.to_owned(), v.to_owned())))
        .collect();
    let get = |key: &str, default: &str| given.get(key).cloned().unwrap_or_else(|| default.to_owned());
    let number = |key: &str, default: &str| get(key, default).parse::<f32>();
    let n: usize = get("n", "256").parse()?;
    let (data, dims) = match get("volume", "noise").as_str() {
        "noise" => (common::noise(n), [n; 3]),
        "vessels" => (common::vessels(n), [n; 3]),
        path => {
            let dims: Vec<usize> = get("dims", "").split('x').map(str::parse).collect::<Result<_, _>>()?;
            (std::fs::read(path)?, [dims[0], dims[1], dims[2]])
        }
    };
    let view = VolumeView::new(Scalars::U8(&data), dims)?;
    let pose = Arcball { rx: number("rx", "20")?, ry: number("ry", "30")?, dz: number("dz", "3.8637")? };
    let size: u32 = get("size", "512").parse()?;
    let frame = Frame {
        step: number("step", "1")?,
        termination: number("termination", "0.99")?,
        shading: match get("shade", "none").as_str() {
            "none" => Shading::None,
            "local" => Shading::Local,
            _ => Shading::Scatter,
        },
        skipping: match get("skip", "blocks").as_str() {
            "none" => Skipping::None,
            "blocks" => Skipping::Blocks,
            _ => Skipping::Distance,
        },
        ..Frame::new(Camera::from_arcball(pose)?.with_fov_y_degrees(30.0)?, size, size)?
    }
    .checked()?;
    let fetch = match get("fetch", "").as_str() {
        "sampler" => Some(VoxelFetch::Sampler),
        "texels" => Some(VoxelFetch::Texels),
        "packed" => Some(VoxelFetch::Packed),
        _ => None,
    };
    let mut renderer: Box<dyn Renderer> = match get("device", "vulkan").as_str() {
        "cpu" => Box::new(CpuRaycaster::new()),
        _ => Box::new(VulkanRaycaster::new(VulkanOptions { fetch, ..VulkanOptions::from_env()? })?),
    };
    println!("{} ({})", renderer.device(), renderer.backend());
    println!("volume {:?}", renderer.set_volume(&view)?);
    let name = get("tf", "medium");
    let table = common::transfer(&name).ok_or_else(|| format!("no transfer function {name:?}"))?;
    println!("transfer {:?}", renderer.set_transfer(&table)?);
    for _ in 0..2 {
        renderer.render(&frame)?;
    }
    let mut times = vec![];
    let mut last = None;
    for _ in 0..get("repeat", "10").parse::<usize>()? {
        let r = renderer.render(&frame)?;
        times.push(r.time);
        last = Some(r);
    }
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v.get(v.len() / 2).map_or(f64::NAN, |t| t * 1e3)
    };
    println!(
        "{name}, medians: device {:.2} ms, wall {:.2} ms, cpu {:.2} ms; least cpu {:.2} ms; {} frames",
        median(times.iter().filter_map(|t| t.device).collect()),
        median(times.iter().map(|t| t.wall).collect()),
        median(times.iter().filter_map(|t| t.cpu).collect()),
        times.iter().filter_map(|t| t.cpu).fold(f64::INFINITY, f64::min) * 1e3,
        times.len()
    );
    if let Some(r) = last {
        if let Some(c) = r.counts {
            println!("{c:?}");
        }
        if let Some(path) = given.get("out") {
            let mut encoder = png::Encoder::new(std::fs::File::create(path)?, r.image.width, r.image.height);
            encoder.set_color(png::ColorType::Rgba);
            let mut over_black = r.image.rgba;
            over_black.chunks_exact_mut(4).for_each(|p| p[3] = 255);
            encoder.write_header()?.write_image_data(&over_black)?;
        }
    }
    Ok(())
}
