use super::*;

const JOB: &str = r#"
name = "t"
sizes = ["16x16", "32x32"]
steps = [1.0, 2.0]
[[volumes]]
files = ["step*.raw"]
series = true
name = "s"
[[cameras]]
kind = "orbit"
views = 4
distances_radii = [2.0, 3.0]
[[cameras]]
kind = "semi-sphere"
views = 5
distances_radii = [2.5]
[[cameras]]
kind = "list"
poses = [[1, 2, 3]]
[[transfer]]
name = "a"
lobes = [[0.5, 0.1, 0.2]]
[[transfer]]
name = "b"
points = [[0, 0, 0, 0, 0], [1, 1, 1, 1, 0.5]]
[renderer]
kind = "command"
command = ["draw", "{volume}", "--out={out}"]
"#;

fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for i in [1, 2, 9, 10, 11] {
        std::fs::write(dir.path().join(format!("step{i}.raw")), vec![0; i]).unwrap();
    }
    dir
}

fn open(text: &str, dir: &Path) -> Result<Job> {
    let file = dir.join("job.toml");
    std::fs::write(&file, text).unwrap();
    Job::open(&file)
}

#[test]
fn a_job_is_all_combinations_and_ids_survive_its_growth() {
    let dir = folder();
    let job = open(JOB, dir.path()).unwrap();
    assert_eq!(job.len(), 5 * (8 + 5 + 1) * 2 * 2 * 2);
    // Numbers in names sort by value.
    assert_eq!(job.volumes.iter().map(|v| v.bytes).collect::<Vec<_>>(), [1, 2, 9, 10, 11]);
    assert_eq!(job.volumes.iter().map(|v| v.time).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    let ids: HashSet<u64> = (0..job.len()).map(|t| job.id(t)).collect();
    assert_eq!(ids.len(), job.len());
    let places: HashSet<String> = (0..job.len()).map(|t| format!("{:?}", job.place(t))).collect();
    assert_eq!(places.len(), job.len());
    // With more views and another output, every existing task keeps its id.
    let grown = JOB.replace("poses = [[1, 2, 3]]", "poses = [[7, 8, 9], [1, 2, 3]]");
    let grown = open(&grown.replace("name = \"t\"", "name = \"u\""), dir.path()).unwrap();
    let more: HashSet<u64> = (0..grown.len()).map(|t| grown.id(t)).collect();
    assert!(ids.is_subset(&more) && more.len() > ids.len());
    // The command's arguments may affect the images, so with other arguments all ids differ.
    let other = open(&JOB.replace("--out=", "-o="), dir.path()).unwrap();
    assert!((0..other.len()).all(|t| !ids.contains(&other.id(t))));
}

#[test]
fn a_job_in_another_folder_has_the_same_ids() {
    let start = JOB.find("[renderer]").unwrap();
    let text = format!("{}[renderer]\nkind = \"pvbatch\"\nscript = \"s.py\"\n", &JOB[..start]);
    let ids = |script: &str| {
        let dir = folder();
        std::fs::write(dir.path().join("s.py"), script).unwrap();
        let job = open(&text, dir.path()).unwrap();
        (0..job.len()).map(|t| job.id(t)).collect::<Vec<_>>()
    };
    let first = ids("pass\n");
    assert_eq!(first, ids("pass\n"));
    assert!(first.iter().zip(ids("exit\n")).all(|(a, b)| *a != b));
}

#[test]
fn characters_of_the_folder_are_no_pattern() {
    let dir = tempfile::tempdir().unwrap();
    for (name, count) in [("a[1]", 2), ("a1", 3)] {
        std::fs::create_dir(dir.path().join(name)).unwrap();
        for i in 0..count {
            std::fs::write(dir.path().join(name).join(format!("step{i}.raw")), vec![0; i + 1]).unwrap();
        }
    }
    let job = open(JOB, &dir.path().join("a[1]")).unwrap();
    assert_eq!(job.volumes.iter().map(|v| v.bytes).collect::<Vec<_>>(), [1, 2]);
}

#[test]
fn semi_spheres_are_even_and_above() {
    let poses = cameras(&[CamerasEntry::SemiSphere { views: 200, distances_radii: vec![2.0] }]).unwrap();
    assert!(poses.iter().all(|p| (0.0..=90.0).contains(&p.rx)));
    // Each view covers an equal area of the half sphere, half of which lies above the circle at 30 degrees.
    assert_eq!(poses.iter().filter(|p| p.rx > 30.0).count(), 100);
    let half = poses.iter().filter(|p| p.ry < 180.0).count();
    assert!((95..=105).contains(&half), "{half}");
}

#[test]
fn every_mistake_is_named() {
    let dir = folder();
    for (from, to, word) in [
        ("name = \"t\"", "name = \"a/b\"", "name is \"a/b\""),
        ("name = \"t\"", "name = \"t\"\noutput = \"x\"", ".cdb"),
        ("step*.raw", "stop*.raw", "no file matches \"stop*.raw\""),
        ("\"16x16\"", "\"16\"", "WIDTHxHEIGHT"),
        ("\"16x16\"", "\"32x32\"", "sizes: entry 2 repeats"),
        ("steps = [1.0, 2.0]", "steps = [0.0]", "steps: 0"),
        ("steps = [1.0, 2.0]", "steps = []", "steps is empty"),
        ("poses = [[1, 2, 3]]", "poses = [[1, 2, -3]]", "cameras: view 14"),
        ("{volume}", "{volum}", "{volum}"),
        ("name = \"b\"", "name = \"a\"", "two entries have the name a"),
        (
            "series = true",
            "series = true\nname = \"s\"\nrange = [0.0, 9.0]\n[[volumes]]\nfiles = [\"step*.raw\"]\nseries = true",
            "give it another `name`",
        ),
        ("--out={out}", "--out", "{out}"),
        ("--out={out}", "--out={{out}}", "{out}"),
        ("kind = \"command\"", "kind = \"comand\"", "comand"),
        ("lobes = [[0.5, 0.1, 0.2]]", "lobes = [[0.5, -0.1, 0.2]]", "transfer a"),
        ("lobes = [[0.5, 0.1, 0.2]]", "", "has neither lobes nor points"),
        (
            "lobes = [[0.5, 0.1, 0.2]]",
            "lobes = [[0.5, 0.1, 0.2]]\npoints = [[0.0, 1.0, 1.0, 1.0, 0.5]]",
            "has both lobes and points",
        ),
        ("views = 5", "views = 5\nvews = 6", "vews"),
        ("kind = \"command\"", "kind = \"command\"\ntimeout_s = -1.0", "timeout_s is -1"),
        ("kind = \"command\"", "kind = \"command\"\ntimeout_s = 1e20", "timeout_s is 1"),
        ("views = 5", "views = 4294967295", "4294967303 views are more"),
        ("views = 4", "views = 9999998", "20000001 views are more"),
        ("[renderer]", "[predict]\nprobe_side = 0\n[renderer]", "probe_side is 0"),
        ("[renderer]", "[predict]\nprobe_side = 25\n[renderer]", "probe_side is 25"),
    ] {
        let text = JOB.replace(from, to);
        assert_ne!(text, JOB, "{from}");
        let said = format!("{:#}", open(&text, dir.path()).unwrap_err());
        assert!(said.contains(word) && said.contains("job.toml"), "{to}: {said}");
    }
    // Settings of the project's raycaster that no frame can have are refused when the job is opened.
    for (steps, termination, word) in
        [("0.001", "0.9", "ray step is 0.001"), ("1.0", "0.0", "termination is 0")]
    {
        let start = JOB.find("[renderer]").unwrap();
        let text = format!(
            "{}[renderer]\nkind = \"entire\"\ntermination = {termination}\n",
            JOB[..start].replace("steps = [1.0, 2.0]", &format!("steps = [{steps}]"))
        );
        let said = format!("{:#}", open(&text, dir.path()).unwrap_err());
        assert!(said.contains(word), "{said}");
    }
    let said = format!("{:#}", open("name = \"x\"\nsizes = 5\n", dir.path()).unwrap_err());
    assert!(said.contains("line 2"), "{said}");
}
