//! A renderer that sleeps for listed times, to test engines; it uses the session protocol of `entire farm`.

use anyhow::{Context, Result};
use entire_farm::read_tasks;
use entire_farm::record::Order;
use entire_report::encode_png;
use entire_vk_raycaster::Image;
use serde::Deserialize;
use std::collections::HashMap;
use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

#[derive(Deserialize)]
struct Asked {
    #[serde(flatten)]
    order: Order,
    out: PathBuf,
}

/// Serves tasks from standard input. A task takes `scale` times the `measured_s` (else `predicted_s`) of its
/// entry in the list, plus `scale` times `load_s` if its volume differs from that of the task before.
pub(crate) fn serve(list: &Path, scale: f64) -> Result<()> {
    let tasks = read_tasks(list)?;
    let times: HashMap<&str, (f64, f64)> = tasks
        .iter()
        .map(|t| (t.task.as_str(), (t.measured_s.or(t.predicted_s).unwrap_or(0.0), t.load_s)))
        .collect();
    let mut held = None;
    for line in std::io::stdin().lock().lines() {
        let clock = Instant::now();
        let asked: Asked = serde_json::from_str(&line?).context("standard input")?;
        let (seconds, load) = *times
            .get(asked.order.task.as_str())
            .with_context(|| format!("{} is not in {}", asked.order.task, list.display()))?;
        let fresh = held.as_ref() != Some(&asked.order.volume);
        let load = if fresh { load * scale } else { 0.0 };
        held = Some(asked.order.volume.clone());
        let [width, height] = asked.order.size;
        let image = Image { width, height, rgba: vec![0; 4 * (width * height) as usize] };
        std::fs::write(&asked.out, encode_png(&image)?)
            .with_context(|| format!("cannot write {}", asked.out.display()))?;
        let rest = Duration::from_secs_f64(seconds * scale + load);
        std::thread::sleep(rest.saturating_sub(clock.elapsed()));
        let answer = serde_json::json!({
            "task": asked.order.task, "seconds": seconds * scale, "load_s": load,
        });
        let mut out = std::io::stdout().lock();
        writeln!(out, "{answer}")?;
        out.flush()?;
    }
    Ok(())
}
