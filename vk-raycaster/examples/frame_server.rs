//! Renders frames on request, so that a script can time them beside those of other renderers in one run.
//! Reads one command per line and answers each with one line, `@@` and a JSON object (`{"err": …}` for an
//! error):
//!
//! ```text
//! make noise|vessels N FILE             writes a generated volume of N³ raw bytes
//! volume FILE NX NY NZ SX SY SZ         loads raw bytes with their spacing; returns the seconds of each part
//! transfer NAME FILE                    sets transparent|medium|opaque|scan, writes its table (256 RGBA f32)
//! camera RX RY DZ WIDTH HEIGHT          sets the camera; returns eye, forward and up in world units, with
//!                                       the origin at a corner of the box
//! frame none|blocks|distance            renders; returns the seconds by each clock
//! counts none|blocks|distance           renders; returns the counts of rays, samples and skips
//! image none|blocks|distance FILE       renders and writes RGB bytes, over black, rows from the top
//! ```

mod common;

use entire_core::scene::{Arcball, Camera, Frame, Scalars, Skipping, VolumeOptions, VolumeView};
use entire_vk_raycaster::{Preparation, Renderer, VulkanOptions, VulkanRaycaster};
use std::error::Error;
use std::io::{BufRead, Write};

struct Server {
    renderer: VulkanRaycaster,
    /// Sizes and spacing of the current volume.
    volume: Option<([usize; 3], [f32; 3])>,
    frame: Option<Frame>,
}

fn numbers<T: std::str::FromStr, const N: usize>(words: &[&str]) -> Result<[T; N], Box<dyn Error>> {
    let all: Vec<T> = words.iter().map_while(|w| w.parse().ok()).collect();
    all.try_into().map_err(|_| format!("{N} numbers are expected: {words:?}").into())
}

/// Returns seconds as a JSON number, or `null` for `None`.
fn part(seconds: Option<f64>) -> String {
    seconds.map_or("null".to_owned(), |v| format!("{v:e}"))
}

fn preparation(p: &Preparation) -> String {
    format!(
        r#""wall": {:e}, "upload": {}, "block_map": {}, "occupancy": {}, "distance_map": {}"#,
        p.wall,
        part(p.upload),
        part(p.block_map),
        part(p.occupancy),
        part(p.distance_map)
    )
}

impl Server {
    fn framed(&self, mode: &str) -> Result<Frame, Box<dyn Error>> {
        let named = Skipping::ALL.into_iter().find(|s| s.name() == mode);
        let skipping = named.ok_or_else(|| format!("no skipping mode {mode:?}"))?;
        Ok(Frame { skipping, ..self.frame.ok_or("no camera was set")? })
    }

    fn answer(&mut self, line: &str) -> Result<String, Box<dyn Error>> {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            ["make", kind, n, file] => {
                let n: usize = n.parse()?;
                let data = match *kind {
                    "noise" => common::noise(n),
                    "vessels" => common::vessels(n),
                    _ => return Err(format!("no volume {kind:?}").into()),
                };
                std::fs::write(file, data)?;
                Ok("{}".to_owned())
            }
            ["volume", file, rest @ ..] if rest.len() == 6 => {
                let dims = numbers(&rest[..3])?;
                let spacing = numbers(&rest[3..])?;
                let data = std::fs::read(file)?;
                let options = VolumeOptions { spacing, ..VolumeOptions::default() };
                let p = self.renderer.set_volume(&VolumeView::with(Scalars::U8(&data), dims, options)?)?;
                self.volume = Some((dims, spacing));
                Ok(format!("{{{}}}", preparation(&p)))
            }
            ["transfer", name, file] => {
                let table = common::transfer(name).ok_or_else(|| format!("no transfer function {name:?}"))?;
                let p = self.renderer.set_transfer(&table)?;
                let bytes: Vec<u8> = table.rgba().iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
                std::fs::write(file, bytes)?;
                let (occupied, all) = self.renderer.occupied_blocks().ok_or("no volume was set")?;
                let share = occupied as f64 / all as f64;
                Ok(format!(r#"{{{}, "occupied": {share:e}}}"#, preparation(&p)))
            }
            ["camera", rest @ ..] if rest.len() == 5 => {
                let [rx, ry, dz] = numbers(&rest[..3])?;
                let [width, height]: [u32; 2] = numbers(&rest[3..])?;
                let (dims, spacing) = self.volume.ok_or("no volume was set")?;
                let camera = Camera::from_arcball(Arcball { rx, ry, dz })?.with_fov_y_degrees(30.0)?;
                self.frame = Some(Frame::new(camera, width, height)?);
                let ([eye, ..], [forward, _, up]) = camera.ray_basis(width, height);
                let extent = [0, 1, 2].map(|a| dims[a] as f32 * spacing[a]);
                let radius = 0.5 * extent.iter().map(|e| e * e).sum::<f32>().sqrt();
                let eye = eye.to_array();
                let eye = [0, 1, 2].map(|a| eye[a] * radius + 0.5 * extent[a]);
                Ok(format!(
                    r#"{{"eye": {eye:?}, "forward": {:?}, "up": {:?}, "fov_y": 30.0}}"#,
                    forward.to_array(),
                    up.to_array()
                ))
            }
            ["frame", mode] => {
                let time = self.renderer.render(&self.framed(mode)?)?.time;
                let (cpu, device) = (part(time.cpu), part(time.device));
                Ok(format!(r#"{{"wall": {:e}, "cpu": {cpu}, "device": {device}}}"#, time.wall))
            }
            ["counts", mode] => {
                let frame = self.framed(mode)?;
                self.renderer.count_work(true);
                let r = self.renderer.render(&frame);
                self.renderer.count_work(false);
                let c = r?.counts.ok_or("no counts")?;
                Ok(format!(r#"{{"rays": {}, "samples": {}, "skips": {}}}"#, c.rays, c.samples, c.skips))
            }
            ["image", mode, file] => {
                let image = self.renderer.render(&self.framed(mode)?)?.image;
                let rgb: Vec<u8> =
                    image.rgba.as_chunks::<4>().0.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect();
                std::fs::write(file, rgb)?;
                Ok(format!(r#"{{"width": {}, "height": {}}}"#, image.width, image.height))
            }
            _ => Err(format!("unknown command {line:?}").into()),
        }
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let renderer = VulkanRaycaster::new(VulkanOptions::from_env()?)?;
    println!(r#"@@{{"name": {:?}}}"#, renderer.device());
    std::io::stdout().flush()?;
    let mut server = Server { renderer, volume: None, frame: None };
    for line in std::io::stdin().lock().lines() {
        match server.answer(&line?) {
            Ok(json) => println!("@@{json}"),
            Err(e) => println!(r#"@@{{"err": {:?}}}"#, e.to_string()),
        }
        std::io::stdout().flush()?;
    }
    Ok(())
}
