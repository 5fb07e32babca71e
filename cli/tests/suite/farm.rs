//! `entire farm` as processes: databases are rendered completely, whatever is killed, and failing tasks are
//! quarantined.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::ball;
use crate::support::{byte_nrrd, entire, fails, json, refuses, stderr, succeeds, words};

const RENDERER: &str = "[renderer]\nkind = \"entire\"\ndevice = \"cpu\"\n";

/// Returns a folder with two volumes and a job of 2 x 10 x 2 tasks (volumes, views, steps).
fn setting(renderer: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    ball::write(&dir.path().join("a ball's $(x).nrrd"));
    ball::write(&dir.path().join("second.nrrd"));
    let job = format!(
        "name = \"db\"\nsizes = [\"48x32\"]\nsteps = [1.0, 2.0]\n\
         [[volumes]]\nfiles = [\"*.nrrd\"]\nseries = true\nname = \"ball\"\n\
         [[cameras]]\nkind = \"orbit\"\nviews = 10\nelevation_deg = 15.0\ndistances_radii = [2.5]\n\
         [[transfer]]\nname = \"one\"\nlobes = [[0.5, 0.05, 0.4]]\n{renderer}"
    );
    std::fs::write(dir.path().join("job.toml"), job).unwrap();
    dir
}

fn images(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut out = BTreeMap::new();
    for part in std::fs::read_dir(folder.join("db.cdb/image")).unwrap() {
        for file in std::fs::read_dir(part.unwrap().path()).unwrap() {
            let path = file.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            // A killed worker leaves no partial file among the images.
            assert!(name.ends_with(".png"), "{name}");
            let bytes = std::fs::read(&path).unwrap();
            out.insert(path.strip_prefix(folder).unwrap().to_owned(), bytes);
        }
    }
    out
}

fn table(folder: &Path) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(folder.join("db.cdb/data.csv")).unwrap();
    reader.deserialize().map(|r| r.unwrap()).collect()
}

fn journal(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("db.cdb/.farm/journal.jsonl")).unwrap()
}

#[test]
fn a_database_is_rendered_and_its_table_names_every_image() {
    let dir = setting(RENDERER);
    let said = succeeds(dir.path(), &["farm", "job.toml", "--slots", "2", "--report", "r.html", "--quiet"]);
    assert!(said.contains("40 of 40 images"), "{said}");
    let rows = table(dir.path());
    assert_eq!(rows.len(), 40);
    let files: HashSet<&str> = rows.iter().map(|r| r["FILE"].as_str()).collect();
    assert_eq!(files.len(), 40);
    for row in &rows {
        assert!(dir.path().join("db.cdb").join(&row["FILE"]).is_file());
        assert!(row["measured_s"].parse::<f64>().unwrap() > 0.0);
        assert!(row["predicted_s"].parse::<f64>().unwrap() > 0.0);
    }
    assert_eq!(rows.iter().map(|r| r["time"].as_str()).collect::<HashSet<_>>().len(), 2);
    let page = std::fs::read_to_string(dir.path().join("r.html")).unwrap();
    assert!(page.contains("Predicted against measured") && page.contains("local-0"));
    // The image equals the picture that `entire render` draws.
    let row = &rows[7];
    let camera = format!("{},{},{}", row["rx_deg"], row["ry_deg"], row["dz_radii"]);
    let line =
        format!("--camera {camera} --tf 0.5,0.05,0.4 --size 48x32 --step {} --device cpu", row["step"]);
    let arguments = ["render", "a ball's $(x).nrrd", "--out", "one.png"];
    succeeds(dir.path(), &[&arguments[..], &words(&line)[..]].concat());
    let (one, other) = (dir.path().join("one.png"), dir.path().join("db.cdb").join(&row["FILE"]));
    assert_eq!(std::fs::read(one).unwrap(), std::fs::read(other).unwrap());
    // Without --resume, the finished database is refused; with --resume, no task is rendered again.
    refuses(dir.path(), &["farm", "job.toml", "--quiet"], &["--resume"]);
    let said = succeeds(dir.path(), &["farm", "job.toml", "--resume", "--quiet"]);
    assert!(said.contains("40 of 40 images, 0 of them"), "{said}");
    assert_eq!(journal(dir.path()).matches("\"done\"").count(), 40);
    // An image that was damaged is found and rendered again.
    let whole = images(dir.path());
    let victim = dir.path().join(whole.keys().next().unwrap());
    let mut bytes = std::fs::read(&victim).unwrap();
    bytes[40] ^= 1;
    std::fs::write(&victim, bytes).unwrap();
    let said = succeeds(dir.path(), &["farm", "job.toml", "--resume", "--verify", "--quiet"]);
    assert!(said.contains("40 of 40 images, 1 of them"), "{said}");
    assert_eq!(images(dir.path()), whole);
    // If tasks are added to a job, only the new tasks are rendered.
    let text = std::fs::read_to_string(dir.path().join("job.toml")).unwrap();
    std::fs::write(dir.path().join("job.toml"), text.replace("[1.0, 2.0]", "[1.0, 2.0, 4.0]")).unwrap();
    let said = succeeds(dir.path(), &["farm", "job.toml", "--resume", "--preview", "--quiet"]);
    assert!(said.contains("60 of 60 images, 20 of them"), "{said}");
}

fn start(folder: &Path, arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_entire"))
        .args(arguments)
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn children(of: u32) -> Vec<u32> {
    let Ok(processes) = std::fs::read_dir("/proc") else { return Vec::new() };
    let parent = |pid: u32| -> Option<u32> {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
    };
    let numbers = processes.filter_map(|p| p.ok()?.file_name().to_str()?.parse().ok());
    numbers.filter(|pid| parent(*pid) == Some(of)).collect()
}

fn kill(pid: u32, signal: &str) {
    let _ = Command::new("kill").args([signal, &pid.to_string()]).status();
}

#[cfg(target_os = "linux")]
#[test]
fn drivers_and_workers_are_killed_and_nothing_is_lost() {
    let reference = setting(RENDERER);
    succeeds(reference.path(), &["farm", "job.toml", "--slots", "2", "--quiet"]);
    let dir = setting(RENDERER);
    let mut arguments = vec!["farm", "job.toml", "--slots", "2", "--quiet"];
    for round in 0..6u64 {
        let mut driver = start(dir.path(), &arguments);
        std::thread::sleep(Duration::from_millis(30 + 37 * round));
        for worker in children(driver.id()) {
            kill(worker, "-KILL");
        }
        std::thread::sleep(Duration::from_millis(20 * round));
        kill(driver.id(), "-KILL");
        driver.wait().unwrap();
        if arguments.len() == 5 && dir.path().join("db.cdb/.farm/journal.jsonl").exists() {
            arguments.push("--resume");
        }
    }
    // Ctrl-C ends the driver after the current tasks; the next run continues the database.
    let mut driver = start(dir.path(), &arguments);
    std::thread::sleep(Duration::from_millis(60));
    kill(driver.id(), "-INT");
    driver.wait().unwrap();
    if arguments.len() == 5 && journal(dir.path()).contains("\"run\"") {
        arguments.push("--resume");
    }
    succeeds(dir.path(), &arguments);
    // Equal job files give equal task ids and images, so no image may be missing or differ.
    assert_eq!(images(dir.path()), images(reference.path()));
    assert_eq!(table(dir.path()).len(), 40);
    let text = journal(dir.path());
    let done: Vec<&str> = text.lines().filter(|l| l.contains("\"done\"")).collect();
    assert_eq!(done.len(), 40);
}

#[cfg(target_os = "linux")]
#[test]
fn an_interruption_during_the_last_image_is_no_error() {
    let script = "touch begun; sleep 1; cp picture.png \"$0\"";
    let command = format!("command = [\"sh\", \"-c\", {script:?}, \"{{out}}\"]\n");
    let renderer = format!("[renderer]\nkind = \"command\"\n{command}");
    let dir = steps(&renderer);
    let job = format!("{STEPS}{renderer}").replace("16x12", "48x32").replace("views = 2", "views = 1");
    write_job(dir.path(), &job.replace("step*", "step10"));
    ball::write(&dir.path().join("second.nrrd"));
    render_picture(dir.path());
    let mut driver = start(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    while !dir.path().join("begun").exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    kill(driver.id(), "-TERM");
    assert!(driver.wait().unwrap().success());
    assert_eq!(table(dir.path()).len(), 1);
}

/// `nohup` lets a program ignore the signal of a closed terminal.
#[cfg(target_os = "linux")]
#[test]
fn a_signal_that_the_parent_ignores_stays_ignored() {
    let dir = setting(RENDERER);
    let script =
        format!("trap '' HUP; exec {:?} farm job.toml --slots 1 --quiet", env!("CARGO_BIN_EXE_entire"));
    let mut driver = Command::new("sh").args(["-c", &script]).current_dir(dir.path()).spawn().unwrap();
    while !dir.path().join("db.cdb/.farm/run").exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    kill(driver.id(), "-HUP");
    assert!(driver.wait().unwrap().success());
    assert_eq!(table(dir.path()).len(), 40);
}

/// Renders `picture.png` in the folder, for programs that copy it.
fn render_picture(folder: &Path) {
    let line =
        "render second.nrrd --camera 1,2,3 --tf 0.5,0.05,0.4 --size 48x32 --device cpu --out picture.png";
    succeeds(folder, &words(line));
}

#[test]
fn programs_get_names_as_they_are_and_failures_are_set_aside() {
    // The program copies its image from another file; for one view it fails, with a message.
    let script = "#!/bin/sh\n[ -f \"$1\" ] || { echo \"no volume $1\"; exit 3; }\n\
                  [ \"$2\" = 36 ] && { echo \"this view is broken\"; exit 4; }\ncp picture.png \"$3\"\n";
    let renderer = "[renderer]\nkind = \"command\"\n\
                    command = [\"sh\", \"draw.sh\", \"{volume}\", \"{ry_deg}\", \"{out}\"]\n";
    let dir = setting(renderer);
    std::fs::write(dir.path().join("draw.sh"), script).unwrap();
    render_picture(dir.path());
    let farm = "farm job.toml --slots 2 --quiet";
    fails(dir.path(), farm, 1, &["4 tasks were given up", "exit status: 4", "--retry-quarantined"]);
    assert_eq!(table(dir.path()).len(), 36);
    let logs = std::fs::read_dir(dir.path().join("db.cdb/.farm/quarantine")).unwrap();
    let logs: Vec<String> = logs.map(|f| std::fs::read_to_string(f.unwrap().path()).unwrap()).collect();
    assert_eq!(logs.len(), 4);
    assert!(logs.iter().all(|l| l.contains("this view is broken")), "{logs:?}");
    // Each task has three attempts: the journal records two of them as failed, and the third one gives the
    // task up.
    assert_eq!(journal(dir.path()).matches("\"failed\"").count(), 8);
    // A dry run reads the database. It plans quarantined tasks only with --retry-quarantined.
    let said = succeeds(dir.path(), &words("farm job.toml --dry-run --slots 2"));
    assert!(said.contains("4 given up"), "{said}");
    let said = succeeds(dir.path(), &words("farm job.toml --dry-run --slots 2 --resume --retry-quarantined"));
    assert!(!said.contains("given up"), "{said}");
    // After the repair, only the failed tasks are rendered.
    std::fs::write(dir.path().join("draw.sh"), script.replace("= 36", "= 999")).unwrap();
    let again = words("farm job.toml --slots 2 --resume --retry-quarantined --quiet");
    let said = succeeds(dir.path(), &again);
    assert!(said.contains("40 of 40 images, 4 of them"), "{said}");
}

#[test]
fn tasks_that_kill_their_worker_are_set_aside_and_the_others_are_rendered() {
    let renderer = "[renderer]\nkind = \"command\"\n\
                    command = [\"sh\", \"draw.sh\", \"{ry_deg}\", \"{out}\"]\n[retry]\nlosses = 5\n";
    let dir = setting(renderer);
    let script = "#!/bin/sh\n[ \"$1\" = 36 ] && kill -9 $PPID && sleep 9\ncp picture.png \"$2\"\n";
    std::fs::write(dir.path().join("draw.sh"), script).unwrap();
    render_picture(dir.path());
    fails(dir.path(), "farm job.toml --slots 1 --quiet", 1, &["4 tasks were given up"]);
    assert_eq!(table(dir.path()).len(), 36);
}

#[test]
fn a_program_that_stays_is_asked_line_by_line_and_started_again() {
    // The program answers three tasks and ends: every fourth task is lost with it and goes to a new process.
    // A lost task does not count as a failed attempt.
    let script = "n=0\nwhile read -r line; do\n\
                  n=$((n + 1)); [ $n -gt 3 ] && exit 1\n\
                  id=$(printf %s \"$line\" | sed 's/.*\"task\":\"\\([0-9a-f]*\\)\".*/\\1/')\n\
                  out=$(printf %s \"$line\" | sed 's/.*\"out\":\"\\([^\"]*\\)\".*/\\1/')\n\
                  cp picture.png \"$out\"; echo starting\n\
                  echo \"{\\\"task\\\": \\\"$id\\\", \\\"seconds\\\": 0.5}\"\n\
                  done\n";
    let dir = setting("[renderer]\nkind = \"session\"\ncommand = [\"sh\", \"stay.sh\"]\n");
    std::fs::write(dir.path().join("stay.sh"), script).unwrap();
    render_picture(dir.path());
    let said = succeeds(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    assert!(said.contains("40 of 40 images"), "{said}");
    assert!(!journal(dir.path()).contains("\"failed\""));
}

#[test]
fn plans_cost_nothing_and_mistakes_are_named() {
    let dir = setting(RENDERER);
    let arguments = ["farm", "job.toml", "--dry-run", "--slots", "4", "--deadline", "1h", "--price", "0.5"];
    let said = succeeds(dir.path(), &arguments);
    assert!(
        said.contains("40 tasks: 2 volumes x 10 views")
            && said.contains("fewest nodes that meet the deadline of 1:00 h"),
        "{said}"
    );
    assert!(!dir.path().join("db.cdb").exists());
    let early = "farm job.toml --dry-run --report r.html";
    fails(dir.path(), early, 1, &["db.cdb holds no image yet; render some first"]);
    succeeds(dir.path(), &["farm", "job.toml", "--dry-run", "--save-tasks", "tasks.csv"]);
    let list = std::fs::read_to_string(dir.path().join("tasks.csv")).unwrap();
    assert_eq!(list.lines().count(), 41);
    let schedule = "schedule tasks.csv --nodes 4 --out a.csv";
    succeeds(dir.path(), &words(schedule));
    succeeds(dir.path(), &words(&format!("{schedule} --method queue")));
    // The saved list can be the source of the tasks' expected times.
    let text = std::fs::read_to_string(dir.path().join("job.toml")).unwrap();
    std::fs::write(dir.path().join("told.toml"), text + "\n[predict]\nlist = \"tasks.csv\"\n").unwrap();
    let said = succeeds(dir.path(), &["farm", "told.toml", "--dry-run"]);
    assert!(said.contains("the list "), "{said}");
    let said = succeeds(dir.path(), &words("farm job.toml --openjd t.json --slots 2 --time-limit 90s"));
    let template = json(&dir.path().join("t.json"));
    assert_eq!(template["specificationVersion"], "jobtemplate-2023-09", "{said}");
    // Without measurements, the upper bounds of the bundles exceed the time limit, so the limit is the
    // timeout.
    assert_eq!(template["steps"][0]["script"]["actions"]["onRun"]["timeout"], 90, "{said}");
    refuses(dir.path(), &["farm", "none.toml"], &["cannot read the job file none.toml"]);
    refuses(dir.path(), &["farm", "job.toml", "--slots", "0"], &["--slots is 0"]);
    let many = words("farm job.toml --dry-run --slots 1000000000000");
    refuses(dir.path(), &many, &["--slots is 1000000000000", "1 to 1048576"]);
    succeeds(dir.path(), &["farm", "job.toml", "--dry-run", "--save-tasks", "new/tasks.csv"]);
    for (more, parts) in [
        (&["--cpus", "2"][..], ["--cpus has no effect with --engine local", "--engine hyperqueue"]),
        (&["--sbatch=-p", "--dry-run"], ["--sbatch has no effect", "--engine slurm"]),
        (
            &["--engine", "slurm", "--sbatch=-p", "--dry-run"],
            ["--sbatch has no effect with --dry-run", "leave"],
        ),
        (&["--resume", "--verify", "--dry-run"], ["--verify has no effect with --dry-run", "leave"]),
        (&["--resume", "--dry-run"], ["--resume has no effect with --dry-run", "leave"]),
        (&["--time-limit", "1h"], ["--time-limit has no effect", "--engine hyperqueue or slurm"]),
        (&["--dry-run", "--save-tasks", "job.toml"], ["--save-tasks: job.toml", "would be replaced"]),
        (&["--report", "second.nrrd"], ["--report: second.nrrd", "would be replaced"]),
        (&["--save-tasks", "db.cdb/data.csv"], ["--save-tasks: db.cdb/data.csv", "written by this command"]),
        (&["--report", "r.csv", "--save-tasks", "./r.csv"], ["./r.csv is given twice", "first as r.csv"]),
    ] {
        refuses(dir.path(), &[&["farm", "job.toml"], more].concat(), &parts);
    }
    let replaced = words("farm told.toml --dry-run --save-tasks tasks.csv");
    refuses(dir.path(), &replaced, &["--save-tasks: tasks.csv", "would be replaced"]);
    assert_eq!(std::fs::read_to_string(dir.path().join("tasks.csv")).unwrap(), list);
    for (more, part) in [
        ("--price 1", "--dry-run"),
        ("--deadline 1h", "--dry-run"),
        ("--openjd u.json --report r.html", "--report"),
        ("--openjd u.json --save-tasks u.csv", "--save-tasks"),
        ("--openjd u.json --deadline 1h", "--deadline"),
        ("--list --verify", "--verify"),
        ("--list --price 1", "--price"),
        ("--list --slots 2", "--slots"),
    ] {
        fails(dir.path(), &format!("farm job.toml {more}"), 2, &[part]);
    }
    let many = words("schedule tasks.csv --nodes 9000000000000 --out a.csv");
    refuses(dir.path(), &many, &["--nodes is"]);
    let list = "predicted_s,volume,load_s\n1,v,1e308\n1,w,1e308\n";
    std::fs::write(dir.path().join("long.csv"), list).unwrap();
    let long = words("schedule long.csv --nodes 1 --method queue --out a.csv");
    refuses(dir.path(), &long, &["more seconds than a number can hold", "load_s"]);
    // Runs the worker on every bundle of the Open Job Description template, as an external render manager would.
    // The report of the resumed farm then includes these images.
    for order in std::fs::read_dir(dir.path().join("db.cdb/.farm/orders")).unwrap() {
        let number = order.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned();
        succeeds(dir.path(), &["farm-worker", "db.cdb/.farm", "--bundle", &number]);
    }
    let said = succeeds(dir.path(), &["farm", "job.toml", "--resume", "--report", "r.html"]);
    assert!(said.contains("40 of 40 images, 0 of them"), "{said}");
    let done = journal(dir.path());
    let done: Vec<serde_json::Value> = done.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let pairs = done
        .iter()
        .filter_map(|e| Some((e["done"]["predicted_s"].as_f64()?, e["done"]["answer"]["seconds"].as_f64()?)));
    assert_eq!(pairs.filter(|(expected, took)| expected != took).count(), 40, "{}", journal(dir.path()));
    let other = words("farm job.toml --resume --engine hyperqueue --python no-such-python");
    refuses(dir.path(), &other, &["no-such-python", "--python"]);
}

/// Writes a volume of 8³ voxels of one value, except one voxel of 0 and one of 255.
fn write_level(path: &Path, level: u8) {
    let values = std::iter::once(255).chain(std::iter::repeat_n(level, 510)).chain([0]);
    std::fs::write(path, byte_nrrd([8; 3], values)).unwrap();
}

const STEPS: &str = "name = \"db\"\nsizes = [\"16x12\"]\nsteps = [1.0]\n\
    [[volumes]]\nfiles = [\"step*.nrrd\"]\nseries = true\nname = \"run\"\n\
    [[cameras]]\nkind = \"orbit\"\nviews = 2\ndistances_radii = [2.5]\n\
    [[transfer]]\nname = \"ramp\"\npoints = [[0, 0, 0, 0, 0.5], [1, 1, 1, 1, 0.5]]\n";

/// Returns a folder with `step10.nrrd`, `step20.nrrd` and a job that renders two views of each volume.
fn steps(renderer: &str) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_level(&dir.path().join("step10.nrrd"), 60);
    write_level(&dir.path().join("step20.nrrd"), 160);
    write_job(dir.path(), &format!("{STEPS}{renderer}"));
    dir
}

fn write_job(folder: &Path, text: &str) {
    std::fs::write(folder.join("job.toml"), text).unwrap();
}

/// Contents of a database: the parameters of every row, and the bytes of its picture.
fn shown(folder: &Path, database: &str) -> Vec<(String, Vec<u8>)> {
    let mut reader = csv::Reader::from_path(folder.join(database).join("data.csv")).unwrap();
    let rows = reader.deserialize().map(|r| r.unwrap()).map(|row: BTreeMap<String, String>| {
        let keys = ["volume", "time", "rx_deg", "ry_deg", "dz_radii", "transfer", "width", "height", "step"];
        let picture = std::fs::read(folder.join(database).join(&row["FILE"])).unwrap();
        (keys.map(|k| row[k].as_str()).join(" "), picture)
    });
    rows.collect()
}

/// Continues the database and compares it with one that is rendered from scratch; returns both outputs.
fn resumed_is_fresh(folder: &Path, case: &str) -> (String, String) {
    let output = entire(folder, &["farm", "job.toml", "--slots", "1", "--resume"]);
    assert_eq!(output.status.code(), Some(0), "{case}: {}", stderr(&output));
    let text = std::fs::read_to_string(folder.join("job.toml")).unwrap();
    std::fs::write(folder.join("fresh.toml"), format!("output = \"fresh.cdb\"\n{text}")).unwrap();
    let _ = std::fs::remove_dir_all(folder.join("fresh.cdb"));
    succeeds(folder, &["farm", "fresh.toml", "--slots", "1", "--quiet"]);
    assert_eq!(shown(folder, "db.cdb"), shown(folder, "fresh.cdb"), "{case}");
    (String::from_utf8(output.stdout.clone()).unwrap(), stderr(&output))
}

#[test]
fn a_resumed_database_shows_what_its_files_are_now() {
    let dir = steps(RENDERER);
    let at = |name: &str| dir.path().join(name);
    let resumed = |case: &str, expected: &str| {
        let (said, notes) = resumed_is_fresh(dir.path(), case);
        assert!(said.contains(expected), "{case}: {said}");
        notes
    };
    let said = succeeds(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    assert!(said.contains("4 of 4 images"), "{said}");
    let first = shown(dir.path(), "db.cdb");
    assert_ne!(first[0].1, first[2].1);
    // A file that is rewritten with the same bytes counts as unchanged.
    write_level(&at("step20.nrrd"), 160);
    assert_eq!(resumed("touched", "4 of 4 images, 0 of them"), "");
    write_level(&at("step20.nrrd"), 240);
    let notes = resumed("content", "4 of 4 images, 2 of them");
    assert!(
        notes.contains("step20.nrrd") && notes.contains("2 pictures") && notes.contains("again"),
        "{notes}"
    );
    assert_eq!(notes.lines().count(), 1, "{notes}");
    assert_eq!(resumed("said once", "4 of 4 images, 0 of them"), "");
    // One time step is added between the two, and one before them: existing pictures are kept, at their new
    // times.
    write_level(&at("step15.nrrd"), 100);
    write_level(&at("step9.nrrd"), 30);
    resumed("addition", "8 of 8 images, 4 of them");
    std::fs::remove_file(at("step10.nrrd")).unwrap();
    let notes = resumed("deletion", "6 of 6 images, 0 of them");
    assert!(notes.contains("2 pictures") && notes.contains("no task"), "{notes}");
    // If a removed file is restored, its pictures are used again.
    write_level(&at("step10.nrrd"), 60);
    resumed("the same again", "8 of 8 images, 0 of them");
    // One file gets other content under its name; another file is removed, and a new one is added.
    write_level(&at("step10.nrrd"), 61);
    std::fs::remove_file(at("step9.nrrd")).unwrap();
    write_level(&at("step12.nrrd"), 30);
    resumed("all at once", "8 of 8 images, 4 of them");
    // Two files exchange their names.
    std::fs::rename(at("step12.nrrd"), at("x")).unwrap();
    std::fs::rename(at("step20.nrrd"), at("step12.nrrd")).unwrap();
    std::fs::rename(at("x"), at("step20.nrrd")).unwrap();
    resumed("names", "8 of 8 images, 4 of them");
    std::fs::rename(at("step15.nrrd"), at("step30.nrrd")).unwrap();
    resumed("another name and place", "8 of 8 images");
}

#[test]
fn a_resumed_database_follows_the_settings() {
    let dir = steps(RENDERER);
    succeeds(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    let job = format!("{STEPS}{RENDERER}");
    for (from, to, now) in [
        ("16x12", "12x16", 4),
        ("[1.0]", "[2.0]", 4),
        ("0.5]]", "0.25]]", 4),
        ("views = 2", "views = 3", 4),
        ("[2.5]", "[3.0]", 4),
        ("series = true", "series = true\nrange = [0.0, 200.0]", 4),
        ("device = ", "termination = 0.5\ndevice = ", 4),
        ("device = ", "shade = \"local\"\ndevice = ", 4),
        ("name = \"db\"", "name = \"db\"\nfov_y_deg = 40.0", 4),
        // Names of volumes do not change the raycaster's pictures.
        ("name = \"run\"", "name = \"other\"", 0),
        // The order of the files and their time steps do not change the pictures either.
        ("files = [\"step*.nrrd\"]", "files = [\"step20.nrrd\", \"step10.nrrd\"]", 0),
        ("series = true\nname = \"run\"", "series = false", 0),
    ] {
        let text = job.replace(from, to);
        assert_ne!(text, job, "{from}");
        write_job(dir.path(), &text);
        let (said, _) = resumed_is_fresh(dir.path(), to);
        assert!(said.contains(&format!("images, {now} of them")), "{to}: {said}");
        // With the first job file, the earlier pictures are used again without rendering.
        write_job(dir.path(), &job);
        let (said, _) = resumed_is_fresh(dir.path(), from);
        assert!(said.contains("4 of 4 images, 0 of them"), "{from}: {said}");
    }
}

#[test]
fn data_files_of_headers_count_too() {
    let dir = steps(RENDERER);
    for (name, level) in [("step10", 60u8), ("step20", 160)] {
        std::fs::remove_file(dir.path().join(format!("{name}.nrrd"))).unwrap();
        let header = format!(
            "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 8 8 8\nencoding: raw\ndata file: {name}.dat\n\n"
        );
        std::fs::write(dir.path().join(format!("{name}.nhdr")), header).unwrap();
        std::fs::write(dir.path().join(format!("{name}.dat")), [vec![255], vec![level; 511]].concat())
            .unwrap();
    }
    write_job(dir.path(), &format!("{STEPS}{RENDERER}").replace("step*.nrrd", "step*.nhdr"));
    succeeds(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    std::fs::write(dir.path().join("step20.dat"), [vec![255], vec![240; 511]].concat()).unwrap();
    let (said, notes) = resumed_is_fresh(dir.path(), "data");
    assert!(said.contains("4 of 4 images, 2 of them") && notes.contains("step20.dat"), "{said}{notes}");
}

#[cfg(unix)]
#[test]
fn programs_that_are_told_times_draw_them_anew() {
    let renderer = "[renderer]\nkind = \"command\"\n\
                    command = [\"sh\", \"-c\", \"cp p$0.png $1\", \"{time}\", \"{out}\"]\n";
    let dir = steps(renderer);
    write_job(dir.path(), &format!("{STEPS}{renderer}").replace("16x12", "48x32"));
    ball::write(&dir.path().join("second.nrrd"));
    for (time, next) in [128, 80, 0].into_iter().enumerate() {
        render_picture(dir.path());
        std::fs::rename(dir.path().join("picture.png"), dir.path().join(format!("p{time}.png"))).unwrap();
        write_level(&dir.path().join("second.nrrd"), next);
    }
    succeeds(dir.path(), &["farm", "job.toml", "--slots", "1", "--quiet"]);
    write_level(&dir.path().join("step15.nrrd"), 100);
    let (said, _) = resumed_is_fresh(dir.path(), "times");
    assert!(said.contains("6 of 6 images, 4 of them"), "{said}");
}

#[cfg(unix)]
#[test]
fn a_file_that_changes_while_it_is_drawn_gives_no_picture() {
    let renderer = "[renderer]\nkind = \"command\"\ncommand = [\"sh\", \"draw.sh\", \"{volume}\", \"{out}\"]\n\
                    [retry]\nattempts = 1\n";
    let dir = steps(renderer);
    write_job(dir.path(), &format!("{STEPS}{renderer}").replace("16x12", "48x32"));
    ball::write(&dir.path().join("second.nrrd"));
    render_picture(dir.path());
    std::fs::write(dir.path().join("draw.sh"), "cp picture.png \"$2\"; echo more >> \"$1\"\n").unwrap();
    // A report needs an image. Without any image, the message is still the one on the tasks.
    let farm = "farm job.toml --slots 1 --report r.html --quiet";
    fails(dir.path(), farm, 1, &["4 tasks were given up"]);
    assert!(!dir.path().join("r.html").exists());
    assert!(journal(dir.path()).contains("changed while the farm was running"));
    assert!(table(dir.path()).is_empty());
    std::fs::write(dir.path().join("draw.sh"), "cp picture.png \"$2\"\n").unwrap();
    let (said, _) = resumed_is_fresh(dir.path(), "mended");
    assert!(said.contains("4 of 4 images, 4 of them"), "{said}");
}

#[test]
fn the_order_of_volumes_is_listed_and_nothing_is_rendered() {
    let dir = steps(RENDERER);
    for name in ["step0.5", "step0.25", "step9", "step1e2"] {
        write_level(&dir.path().join(format!("{name}.nrrd")), 9);
    }
    let said = succeeds(dir.path(), &["farm", "job.toml", "--list"]);
    let lines: Vec<Vec<&str>> = said.lines().map(|l| l.split_whitespace().collect()).collect();
    let at = lines.iter().position(|l| l.first() == Some(&"0")).unwrap();
    let expected = ["step0.25", "step0.5", "step9", "step10", "step20", "step1e2"];
    assert_eq!(lines.len() - at, expected.len(), "{said}");
    for (i, (line, name)) in lines[at..].iter().zip(expected).enumerate() {
        assert_eq!(line[..], [&i.to_string(), &i.to_string(), "run", &format!("{name}.nrrd")], "{said}");
    }
    assert!(!dir.path().join("db.cdb").exists());
}
