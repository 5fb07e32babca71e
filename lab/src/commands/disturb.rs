//! `entire-lab disturb`: slowdown of frames over time while another program runs.

use crate::replay::Slowdown;
use crate::stress::Noise;
use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, TransferFunction};
use entire_io::files::{make_folder_of, write_whole};
use entire_io::interrupt;
use entire_io::metrics::median;
use entire_io::options::{Device, open_renderer};
use entire_io::volume::{Reading, open_volume};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use std::path::PathBuf;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Load on the machine by another program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Neighbor {
    /// No load.
    None,
    /// Bursts of 50 to 500 ms on one core; they fill a fifth of the time.
    Bursts,
    /// One core is busy all the time.
    Steady,
    /// No load, but half of the speed for 10 of the 20 seconds: the process is stopped half of the time,
    /// about a millisecond at a time.
    HalfSpeed,
}

/// Record the slowdown of frames over time while another program runs on the machine.
///
/// Draws one frame repeatedly, first without load by the other program, then with this load, and measures
/// wall times. For every frame of the second part, writes its start, and its time divided by the median time
/// of the first part. `entire-lab replay --disturbance` replays recorded paths with these slowdowns.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire-lab disturb data/nyx_cosmology/m04/t0010.nrrd --neighbor bursts \\
      --out bursts.csv")]
pub(crate) struct Options {
    /// The volume file.
    #[arg(value_name = "VOLUME")]
    pub(crate) volume: PathBuf,
    /// Load on the machine by another program.
    #[arg(long, value_enum)]
    pub(crate) neighbor: Neighbor,
    /// The renderer.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) device: Device,
    /// The table to write.
    #[arg(long, value_name = "FILE.csv")]
    pub(crate) out: PathBuf,
}

/// Duration of the first frames, which are not measured, seconds.
const WARM_SECONDS: f64 = 1.0;

/// Duration of the part without the load, seconds; slowdowns are relative to its median frame time.
const QUIET_SECONDS: f64 = 5.0;

/// Duration of the part with the load, seconds.
const LOADED_SECONDS: f64 = 20.0;

/// Image side, pixels; a frame should take a few milliseconds.
const SIDE: u32 = 160;

/// Seed of the bursts.
const SEED: u64 = 1;

/// Puts the load on one core until `stop` is true.
fn disturb(neighbor: Neighbor, stop: &AtomicBool) {
    let mut noise = Noise::new(SEED);
    while !stop.load(Ordering::Relaxed) {
        let burst = Duration::from_secs_f64(0.05 + 0.45 * noise.uniform());
        let begin = Instant::now();
        while begin.elapsed() < burst {
            std::hint::spin_loop();
        }
        if neighbor == Neighbor::Bursts {
            std::thread::sleep(4 * burst);
        }
    }
}

/// Shortest duration for which a process at half the speed runs between two stops. On a busy machine it runs
/// longer; each stop lasts as long as the process ran before it.
const TURN: Duration = Duration::from_millis(1);

/// Records in a child process, which is stopped for about every second millisecond in the middle half of
/// the recording's second part.
fn run_at_half_speed(options: &Options) -> Result<()> {
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("disturb").arg(&options.volume).args(["--neighbor", "none", "--device"]);
    let device = options.device.to_possible_value().context("a device without a name")?;
    command.arg(device.get_name()).arg("--out").arg(&options.out);
    let mut child = command.spawn()?;
    let pid = Pid::from_raw(child.id().cast_signed());
    let begin = Instant::now();
    let slow = WARM_SECONDS + QUIET_SECONDS + 0.25 * LOADED_SECONDS;
    let slow = slow..slow + 0.5 * LOADED_SECONDS;
    // Until the exit status is read, no other process can get this id.
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        let turn = Instant::now();
        std::thread::sleep(TURN);
        if slow.contains(&begin.elapsed().as_secs_f64()) {
            kill(pid, Signal::SIGSTOP)?;
            std::thread::sleep(turn.elapsed());
            kill(pid, Signal::SIGCONT)?;
        }
    };
    ensure!(status.success(), "the recording ended with {status}");
    Ok(())
}

pub(crate) fn run(options: &Options) -> Result<()> {
    if options.neighbor == Neighbor::HalfSpeed {
        return run_at_half_speed(options);
    }
    let volume = open_volume(&options.volume, &Reading::default())?;
    make_folder_of(&options.out)?;
    let stop = interrupt::flag()?;
    let mut renderer = open_renderer(options.device)?;
    renderer.set_volume(&volume.view())?;
    let lobe = GaussianLobe { center: 0.5, width: 0.2, height: 0.05 };
    renderer.set_transfer(&TransferFunction::Gaussian(vec![lobe]).to_table()?)?;
    let camera = Camera::from_arcball(Arcball { rx: 20.0, ry: 30.0, dz: 2.2 })?;
    let frame = Frame::new(camera, SIDE, SIDE)?;
    // Draws frames for `seconds`; returns the start and the wall time of each frame, in seconds.
    let mut draw = |seconds: f64| -> Result<Vec<(f64, f64)>> {
        let begin = Instant::now();
        let mut out = Vec::new();
        while begin.elapsed().as_secs_f64() < seconds {
            ensure!(!interrupt::requested(&stop), "interrupted; nothing was written");
            let start = begin.elapsed().as_secs_f64();
            let wall = renderer.render(&frame)?.time.wall;
            out.push((start, wall));
        }
        Ok(out)
    };
    draw(WARM_SECONDS)?;
    let mut quiet: Vec<f64> = draw(QUIET_SECONDS)?.into_iter().map(|(_, wall)| wall).collect();
    let usual = median(&mut quiet).context("no frame was drawn")?;
    let over = AtomicBool::new(false);
    let drawn = std::thread::scope(|scope| {
        if options.neighbor != Neighbor::None {
            scope.spawn(|| disturb(options.neighbor, &over));
        }
        let drawn = draw(LOADED_SECONDS);
        over.store(true, Ordering::Relaxed);
        drawn
    })?;
    let mut table = csv::Writer::from_writer(Vec::new());
    let first = drawn.first().map_or(0.0, |d| d.0);
    let round = |v: f64, places: f64| (v * places).round() / places;
    for &(start, wall) in &drawn {
        table
            .serialize(Slowdown { start_s: round(start - first, 1e5), slowdown: round(wall / usual, 1e3) })?;
    }
    write_whole(&options.out, &table.into_inner()?)?;
    println!(
        "{}: {} frames, {:.1} ms each when undisturbed, on {}",
        options.out.display(),
        drawn.len(),
        1e3 * usual,
        renderer.device()
    );
    Ok(())
}
