//! A worker: renders the tasks of bundles, one after another. For each task, it writes first the complete
//! image, then the answer to the spool. Image and answer remain if the worker is killed.

use super::command::{Guard, fill, kill, leader};
use super::engine::utf8;
use super::job::{Draw, Renderer, draw_settings, frame};
use super::record::{Answer, BundleOrder, Line, Order, run_number, unix_now};
use super::session::{Reply, Session};
use super::spool::tail;
use anyhow::{Context, Result, bail, ensure};
use entire_core::scene::Arcball;
use entire_io::child::wait_at_most;
use entire_io::files::{make_folder_of, write_whole};
use entire_io::identity;
use entire_io::options::open_renderer;
use entire_io::volume::{Reading, open_volume};
use entire_report::encode_png;
use serde::de::DeserializeOwned;
use std::fs::{File, OpenOptions};
use std::io::{BufRead, Read, Write};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

/// True if an error says that the disk, or the user's share of it, is full.
pub(crate) fn is_full(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded)
}

/// True if a cause of an error says that the disk is full.
pub(crate) fn says_full(error: &anyhow::Error) -> bool {
    error.chain().filter_map(|e| e.downcast_ref::<std::io::Error>()).any(is_full)
}

fn read_json<T: DeserializeOwned>(file: &Path) -> Result<T> {
    let text = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    serde_json::from_slice(&text).with_context(|| format!("{}", file.display()))
}

enum Painter {
    /// The raycaster, with its loaded volume.
    Own(Box<Own>),
    /// A program that is started for each image, and its time limit.
    Program(Vec<String>, Option<Duration>),
    Stays(Session),
}

struct Own {
    renderer: Box<dyn entire_vk_raycaster::Renderer>,
    draw: Draw,
    held: Option<(PathBuf, Reading)>,
    transfer: Option<entire_io::path::Transfer>,
}

/// State of a worker.
pub struct Worker {
    state: PathBuf,
    output: PathBuf,
    node: String,
    painter: Painter,
}

impl Worker {
    /// Returns a worker of the database whose state folder is `state`.
    ///
    /// # Errors
    /// When the renderer's description cannot be read, or no renderer can be opened.
    pub fn open(state: &Path, node: String) -> Result<Self> {
        let renderer: Renderer = read_json(&state.join("renderer.json"))?;
        let limit = |t: &Option<f64>| t.map(Duration::from_secs_f64);
        let painter = match &renderer {
            Renderer::Entire { .. } => {
                let (draw, device) = draw_settings(&renderer)?;
                let renderer = open_renderer(device)?;
                Painter::Own(Box::new(Own { renderer, draw, held: None, transfer: None }))
            }
            Renderer::Command { command, timeout_s } => Painter::Program(command.clone(), limit(timeout_s)),
            Renderer::Session { command, timeout_s } => {
                Painter::Stays(Session::new(command.clone(), limit(timeout_s)))
            }
            Renderer::Pvbatch { script, args, program, timeout_s } => {
                let script = script.to_str().context("the script's path is not UTF-8; rename it")?.to_owned();
                let command = [vec![program.clone(), script], args.clone()].concat();
                Painter::Stays(Session::new(command, limit(timeout_s)))
            }
        };
        let output = state.parent().context("the state folder has no parent")?.to_owned();
        Ok(Self { state: state.to_owned(), output, node, painter })
    }

    /// Reads bundles from standard input, one JSON object per line, until it is closed; then ends after the
    /// current task. Writes the answers to standard output and to the spool.
    ///
    /// # Errors
    /// When a line is no bundle, or the spool cannot be written.
    pub fn serve(&mut self) -> Result<()> {
        let closed = Arc::new(AtomicBool::new(false));
        let (send, bundles) = mpsc::channel();
        let flag = closed.clone();
        std::thread::spawn(move || {
            for line in std::io::stdin().lock().lines() {
                let Ok(line) = line else { break };
                let bundle = serde_json::from_str::<BundleOrder>(&line).context("standard input");
                if send.send(bundle).is_err() {
                    return;
                }
            }
            flag.store(true, Ordering::SeqCst);
        });
        let name = format!("local-{}-{}.jsonl", std::process::id(), (unix_now() * 1e3) as u64);
        let mut spool = open_spool(&self.state.join("spool").join(name))?;
        for bundle in bundles {
            let bundle = bundle?;
            for order in &bundle.tasks {
                if closed.load(Ordering::SeqCst) {
                    return Ok(());
                }
                say(&Line::Begin { begins: order.task.clone() });
                let answer = Line::Answer(self.answer(order, bundle.bundle));
                append(&mut spool, &answer)?;
                say(&answer);
            }
            say(&Line::End { end: bundle.bundle });
        }
        Ok(())
    }

    /// Renders the bundle that `orders/NUMBER.json` describes and writes the answers to `spool/NUMBER.jsonl`.
    /// Tasks that the spool lists as done are not rendered again.
    ///
    /// # Errors
    /// When the description cannot be read or the spool cannot be written.
    pub fn bundle(&mut self, number: u64) -> Result<()> {
        let bundle: BundleOrder = read_json(&self.state.join("orders").join(format!("{number}.json")))?;
        let path = super::spool::path(&self.state, number);
        let done: Vec<String> = super::spool::lines(&path)?
            .into_iter()
            .filter_map(|l| if let Line::Answer(a) = l { a.error.is_none().then_some(a.task) } else { None })
            .collect();
        let mut spool = open_spool(&path)?;
        let cancel = self.state.join("cancel").join(number.to_string());
        for order in bundle.tasks.iter().filter(|o| !done.contains(&o.task)) {
            if cancel.exists() || run_number(&self.state) != Some(bundle.run) {
                break;
            }
            append(&mut spool, &Line::Begin { begins: order.task.clone() })?;
            let answer = self.answer(order, number);
            append(&mut spool, &Line::Answer(answer))?;
        }
        append(&mut spool, &Line::End { end: number })
    }

    /// Renders a task and returns the result. If the task fails, the result has the error.
    fn answer(&mut self, order: &Order, bundle: u64) -> Answer {
        let begin = unix_now();
        let clock = Instant::now();
        let mut answer = Answer {
            task: order.task.clone(),
            bundle,
            node: self.node.clone(),
            begin,
            predicted_s: order.predicted_s,
            ..Answer::default()
        };
        match self.paint(order) {
            Ok((painted, bytes, crc32)) => {
                answer.load_s = painted.load_s.unwrap_or(0.0);
                answer.render_s = painted.seconds;
                let lost_s = answer.load_s + painted.lost_s;
                answer.seconds = (clock.elapsed().as_secs_f64() - lost_s).max(1e-9);
                (answer.bytes, answer.crc32) = (bytes, crc32);
            }
            Err(error) => {
                answer.seconds = clock.elapsed().as_secs_f64();
                answer.disk_full = says_full(&error);
                answer.error = Some(format!("{error:#}"));
            }
        }
        answer.end = begin + clock.elapsed().as_secs_f64();
        answer
    }

    fn paint(&mut self, order: &Order) -> Result<(Reply, u64, u32)> {
        let out = self.output.join(&order.image);
        make_folder_of(&out)?;
        // A folder for this image only: a program that is still writing after it was killed cannot overwrite
        // another image. The next run removes the folder of a killed worker.
        let parts = self.state.join("parts");
        let folder = tempfile::Builder::new().prefix("p").tempdir_in(&parts);
        let folder = folder.with_context(|| format!("cannot make a folder in {}", parts.display()))?;
        let part = folder.path().join(format!("{}.png", order.task));
        let log = self.state.join("logs").join(format!("{}.log", order.task));
        let (painted, drawn) = match &mut self.painter {
            Painter::Own(own) => own.paint(order).map(|(painted, png)| (painted, Some(png)))?,
            Painter::Program(command, limit) => (run(command, *limit, order, &part, &log)?, None),
            Painter::Stays(session) => (session.ask(order, &part, &log)?, None),
        };
        let png = match drawn {
            Some(png) => png,
            None => std::fs::read(&part).with_context(|| {
                format!("the renderer succeeded but wrote no image; its output is in {}", log.display())
            })?,
        };
        check_png(&png, order.size)?;
        if let Some(what) = identity::changed(&order.volume, &order.files)? {
            bail!(
                "{} changed while the farm was running: {what}; continue with --resume once the volume is \
                 complete",
                order.volume.display()
            );
        }
        let whole = folder.path().join("whole.png");
        write_whole(&whole, &png)?;
        std::fs::rename(&whole, &out).with_context(|| format!("cannot write {}", out.display()))?;
        // The log of a failed task stays: if the task is given up, the driver keeps the end of this log.
        let _ = std::fs::remove_file(&log);
        Ok((painted, png.len() as u64, crc32fast::hash(&png)))
    }
}

impl Own {
    fn paint(&mut self, order: &Order) -> Result<(Reply, Vec<u8>)> {
        let [rx, ry, dz] = order.camera;
        let frame = frame(Arcball { rx, ry, dz }, order.fov_y_deg, order.size, order.step, self.draw)?;
        let clock = Instant::now();
        let mut load_s = None;
        if self.held.as_ref().is_none_or(|(path, how)| *path != order.volume || *how != order.reading) {
            self.held = None;
            let volume = open_volume(&order.volume, &order.reading)?;
            self.renderer
                .set_volume(&volume.view())
                .with_context(|| format!("{}", order.volume.display()))?;
            self.held = Some((order.volume.clone(), order.reading.clone()));
            self.transfer = None;
            load_s = Some(clock.elapsed().as_secs_f64());
        }
        if self.transfer.as_ref() != Some(&order.transfer) {
            self.transfer = None;
            self.renderer.set_transfer(&order.transfer.function().to_table()?)?;
            self.transfer = Some(order.transfer.clone());
        }
        let rendered = self.renderer.render(&frame)?;
        let png = encode_png(&rendered.image)?;
        Ok((Reply { load_s, seconds: Some(rendered.time.seconds()), ..Reply::default() }, png))
    }
}

fn placeholders(order: &Order, out: &Path) -> Result<Vec<(&'static str, String)>> {
    Ok(vec![
        ("volume", utf8(order.volume.as_os_str())?),
        ("volume_name", order.volume_name.clone()),
        ("time", order.time.to_string()),
        ("rx_deg", order.camera[0].to_string()),
        ("ry_deg", order.camera[1].to_string()),
        ("dz_radii", order.camera[2].to_string()),
        ("fov_y_deg", order.fov_y_deg.to_string()),
        ("transfer", serde_json::to_string(&order.transfer)?),
        ("transfer_name", order.transfer_name.clone()),
        ("width", order.size[0].to_string()),
        ("height", order.size[1].to_string()),
        ("step", order.step.to_string()),
        ("out", utf8(out.as_os_str())?),
        ("task", order.task.clone()),
    ])
}

fn run(command: &[String], limit: Option<Duration>, order: &Order, out: &Path, log: &Path) -> Result<Reply> {
    let values = placeholders(order, out)?;
    let value = |name: &str| values.iter().find(|(n, _)| *n == name).map(|(_, text)| text.as_str());
    let words = command.iter().map(|a| fill(a, value)).collect::<Result<Vec<_>>>()?;
    let (program, arguments) = words.split_first().context("the command is empty")?;
    let file = File::create(log).with_context(|| format!("cannot write {}", log.display()))?;
    let mut child = leader(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(file.try_clone()?)
        .stderr(file)
        .spawn()
        .with_context(|| format!("cannot start {program:?}; check the renderer's command"))?;
    let _guard = Guard::of(&child);
    let status = match limit {
        None => child.wait()?,
        Some(limit) => match wait_at_most(&mut child, limit)? {
            Some(status) => status,
            None => {
                kill(&mut child);
                bail!("{program:?} was ended after {} s (timeout_s)", limit.as_secs_f64())
            }
        },
    };
    ensure!(status.success(), "{program:?} ended with {status}: {}", tail(log));
    Ok(Reply::default())
}

fn check_png(bytes: &[u8], size: [u32; 2]) -> Result<()> {
    let whole = bytes.len() >= 33 && bytes.starts_with(b"\x89PNG\r\n\x1a\n") && bytes[12..16] == *b"IHDR";
    ensure!(whole, "the renderer wrote {} bytes that are no PNG image", bytes.len());
    ensure!(bytes.ends_with(b"IEND\xaeB`\x82"), "the renderer's PNG image is cut off");
    let side = |at: usize| u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let ([width, height], [w, h]) = ([side(16), side(20)], size);
    ensure!(
        [width, height] == size,
        "the renderer's image has {width} x {height} pixels; {w} x {h} were requested"
    );
    Ok(())
}

fn open_spool(path: &Path) -> Result<File> {
    let fail = || format!("cannot write {}", path.display());
    let mut file = OpenOptions::new().create(true).append(true).read(true).open(path).with_context(fail)?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).with_context(fail)?;
    if bytes.last().is_some_and(|b| *b != b'\n') {
        file.write_all(b"\n").with_context(fail)?;
    }
    Ok(file)
}

fn append(spool: &mut File, line: &Line) -> Result<()> {
    let mut text = serde_json::to_vec(line)?;
    text.push(b'\n');
    spool.write_all(&text).context("cannot write the spool file; free disk space and continue with --resume")
}

/// Writes a line to standard output. A closed output is no error, since the spool has the answers.
fn say(line: &Line) {
    if let Ok(text) = serde_json::to_string(line) {
        let mut out = std::io::stdout().lock();
        let _ = writeln!(out, "{text}").and_then(|()| out.flush());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    #[cfg(unix)]
    use crate::{command::wait_for_end, record::an_order};
    use entire_vk_raycaster::Image;

    #[test]
    fn only_whole_images_of_the_right_size_pass() {
        let png = encode_png(&Image { width: 3, height: 2, rgba: vec![9; 24] }).unwrap();
        check_png(&png, [3, 2]).unwrap();
        for (bytes, size, word) in [
            (&png[..], [2, 3], "3 x 2 pixels"),
            (&png[..png.len() - 1], [3, 2], "cut off"),
            (&b"GIF89a"[..], [3, 2], "no PNG"),
            (&[][..], [3, 2], "0 bytes"),
        ] {
            let said = check_png(bytes, size).unwrap_err().to_string();
            assert!(said.contains(word), "{said}");
        }
    }

    /// A worker with an empty database in a folder.
    #[cfg(unix)]
    fn worker(folder: &Path, painter: Painter) -> Worker {
        let state = folder.join(".farm");
        for part in ["parts", "logs"] {
            std::fs::create_dir_all(state.join(part)).unwrap();
        }
        Worker { state, output: folder.to_owned(), node: "n".into(), painter }
    }

    #[cfg(unix)]
    #[test]
    fn the_seconds_of_a_failed_attempt_are_no_rendering_time() {
        let dir = tempfile::tempdir().unwrap();
        let picture = dir.path().join("picture.png");
        let png = encode_png(&Image { width: 1, height: 1, rgba: vec![9; 4] }).unwrap();
        std::fs::write(&picture, png).unwrap();
        // The program answers one task. It reads the next task and ends 1 s later without an answer. A new
        // process then gets this task.
        let script = r#"read -r line; out=${line##*\"out\":\"}; out=${out%%\"*}; cp "$0" "$out"
            echo '{"task": "7", "seconds": 0.01}'; read -r line; sleep 1; exit 1"#;
        let command = ["sh", "-c", script, picture.to_str().unwrap()].map(str::to_owned).to_vec();
        let painter = Painter::Stays(Session::new(command, None));
        let mut worker = worker(dir.path(), painter);
        let [first, second] = [1, 2].map(|bundle| worker.answer(&an_order("v"), bundle));
        assert_eq!((first.error, &second.error), (None, &None));
        let neither = second.end - second.begin - second.seconds - second.load_s;
        assert!(neither > 0.99, "{second:?}");
    }

    #[cfg(unix)]
    #[test]
    fn the_output_of_a_program_stays_if_its_image_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let command = ["sh", "-c", "echo because; echo no image > \"$0\"", "{out}"].map(str::to_owned);
        let painter = Painter::Program(command.to_vec(), None);
        let mut worker = worker(dir.path(), painter);
        let error = worker.answer(&an_order("v"), 1).error.unwrap();
        assert!(error.contains("no PNG"), "{error}");
        assert_eq!(tail(&worker.state.join("logs/7.log")), "because");
    }

    #[cfg(unix)]
    #[test]
    fn at_the_time_limit_the_children_of_a_program_end_too() {
        let dir = tempfile::tempdir().unwrap();
        let (out, log) = (dir.path().join("pid"), dir.path().join("log"));
        let command = ["sh", "-c", "sleep 1000 & echo $! > \"$0\"; wait", "{out}"].map(str::to_owned);
        // A busy machine may need more time to start the program, so the limit grows.
        let pid = (4..).find_map(|k| {
            let limit = Duration::from_millis(1u64 << k);
            assert!(run(&command, Some(limit), &an_order("v"), &out, &log).is_err());
            std::fs::read_to_string(&out).ok().filter(|pid| pid.ends_with('\n'))
        });
        wait_for_end(&pid.unwrap());
    }
}
