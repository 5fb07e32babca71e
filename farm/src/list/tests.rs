//! Task lists, and properties of the simulated queues.

use super::*;
use proptest::prelude::*;

fn ones(n: usize) -> Vec<f64> {
    vec![1.0; n]
}

fn list(text: &str, name: &str) -> Result<Vec<Task>> {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join(name);
    std::fs::write(&file, text).unwrap();
    read_tasks(&file)
}

#[test]
fn lists_are_read_in_both_forms_and_every_mistake_is_named() {
    let csv = list("task,predicted_s,measured_s,volume,load_s\na,1,2,v,0.5\n,3,,,0\n", "t.csv").unwrap();
    assert_eq!((csv[0].predicted_s, csv[0].measured_s, csv[0].load_s), (Some(1.0), Some(2.0), 0.5));
    assert_eq!((csv[1].task.as_str(), csv[1].measured_s), ("1", None));
    let few = list("predicted_s\n1\n2\n", "t.csv").unwrap();
    assert_eq!(few.len(), 2);
    let json = list(r#"[{"predicted_s": 1.5, "volume": "v"}]"#, "t.json").unwrap();
    assert_eq!((json[0].predicted_s, json[0].volume.as_str()), (Some(1.5), "v"));
    for (text, name, expected) in [
        ("predicted_s\n-1\n", "t.csv", "predicted_s is -1"),
        ("predicted_s\nNaN\n", "t.csv", "predicted_s is NaN"),
        ("predicted_s\nx\n", "t.csv", "invalid float"),
        ("task\na\n", "t.csv", "neither predicted_s nor measured_s"),
        ("predicted_s,speed\n1,2\n", "t.csv", "unknown field"),
        ("predicted_s\n", "t.csv", "no task"),
        ("[]", "t.json", "no task"),
        ("{", "t.json", "task list"),
    ] {
        let message = format!("{:#}", list(text, name).unwrap_err());
        assert!(message.contains(expected), "{text:?}: {message}");
    }
}

#[test]
fn lists_of_spreadsheets_are_read() {
    let plain = "task,predicted_s\na,3.5\n\"b, part 2\",1.25\nc,2.0\nd,4.0\n";
    let right = parse_tasks(plain.as_bytes(), false).unwrap();
    let names: Vec<&str> = right.iter().map(|t| t.task.as_str()).collect();
    let seconds: Vec<f64> = right.iter().filter_map(|t| t.predicted_s).collect();
    assert_eq!((names, seconds), (vec!["a", "b, part 2", "c", "d"], vec![3.5, 1.25, 2.0, 4.0]));
    let semicolons = "task;predicted_s\na;3,5\nb, part 2;1,25\nc;2,0\nd;4,0\n";
    let marked = format!("\u{feff}{plain}");
    let utf16 = |text: &str| text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>();
    for (bytes, what) in [
        (semicolons.as_bytes().to_vec(), "semicolons and decimal commas"),
        (semicolons.replace(';', "\t").into_bytes(), "tabs"),
        (semicolons.replace(',', ".").replace("b. ", "b, ").into_bytes(), "semicolons and points"),
        (plain.replace('\n', "\r\n").into_bytes(), "CRLF"),
        (marked.clone().into_bytes(), "a byte order mark"),
        (utf16(&marked), "UTF-16"),
        (utf16(&format!("\u{feff}{}", semicolons.replace(';', "\t"))), "UTF-16 with tabs"),
    ] {
        assert_eq!(parse_tasks(&bytes, false).unwrap(), right, "{what}");
    }
    let json = "\u{feff}[{\"task\": \"a\", \"predicted_s\": 1.0}]";
    assert_eq!(parse_tasks(json.as_bytes(), true).unwrap()[0].predicted_s, Some(1.0));
    for (bytes, expected) in [
        (&b"task;predicted_s\na;1.234,5\n"[..], "invalid float"),
        (b"task;speed\na;1\n", "unknown field"),
        (b"task,predicted_s\n\xe4,1\n", "byte 17 is not UTF-8"),
    ] {
        let message = format!("{:#}", parse_tasks(bytes, false).unwrap_err());
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn a_queue_is_as_long_as_its_longest_task_where_that_goes_first() {
    let mut times = vec![1.0; 20];
    times[19] = 100.0;
    let arrival: Vec<usize> = (0..20).collect();
    assert!(simulate_queue(&arrival, &times, &[], &ones(8)).unwrap().makespan > 100.0);
    let order = longest_first(&times).unwrap();
    assert_eq!(simulate_queue(&order, &times, &[], &ones(8)).unwrap().makespan, 100.0);
}

#[test]
fn nonsense_is_refused() {
    for order in [&[0, 0][..], &[0][..], &[0, 2][..]] {
        assert!(simulate_queue(order, &[1.0, 2.0], &[], &[1.0]).is_err(), "{order:?}");
    }
    assert!(simulate_queue(&[0], &[1.0], &[(0, f64::INFINITY)], &[1.0]).is_err());
    for (times, speeds) in [(&[f64::NAN][..], &[1.0][..]), (&[-1.0], &[1.0]), (&[1.0], &[0.0]), (&[1.0], &[])]
    {
        assert!(simulate_queue(&[0], times, &[], speeds).is_err(), "{times:?} {speeds:?}");
    }
    let many = vec![1.0; MAX_NODES + 1];
    assert!(assign_longest_first(&[1.0], &many[1..]).is_ok());
    assert!(assign_longest_first(&[1e308; 2], &[4.0, 2.0]).is_ok());
    for (times, speeds, expected) in [
        (&[1.0][..], &[][..], "no nodes"),
        (&[1.0, f64::NAN], &[1.0], "task 1"),
        (&[-1.0], &[1.0], "task 0"),
        (&[1.0], &[1.0, 0.0], "node 1"),
        (&[1e308; 2], &[2.0, 1.0], "add up to more"),
        (&[1.0], &many, "1048577 nodes, but at most 1048576"),
    ] {
        let message = assign_longest_first(times, speeds).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
    let assigned = |node_of: &[usize]| Assignment { node_of: node_of.to_vec(), nodes: 1 };
    assert_eq!(assigned(&[]).makespan(&[], &[1.0]).unwrap(), 0.0);
    for (node_of, expected) in [(&[0, 0][..], "1 times and 1 speeds"), (&[5], "names node 5; its 1 nodes")] {
        let message = assigned(node_of).makespan(&[1.0], &[1.0]).unwrap_err().to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn equal_times_are_dealt_out_in_turn() {
    // Nodes are also taken in turn if the tasks take no time.
    for seconds in [1.0, 0.0] {
        let a = assign_longest_first(&[seconds; 10], &ones(4)).unwrap();
        let mut counts = [0; 4];
        a.node_of.iter().for_each(|&n| counts[n] += 1);
        assert_eq!(counts, [3, 3, 2, 2]);
    }
}

#[test]
fn fast_nodes_get_more() {
    let a = assign_longest_first(&[1.0; 30], &[2.0, 1.0]).unwrap();
    assert_eq!(a.node_of.iter().filter(|&&n| n == 0).count(), 20);
    assert_eq!(a.makespan(&[1.0; 30], &[2.0, 1.0]).unwrap(), 10.0);
}

#[test]
fn exchanges_repair_grahams_worst_case() {
    // Two nodes, tasks 3 3 2 2 2: longest first ends at 7, the best schedule at 6.
    let times = [3.0, 3.0, 2.0, 2.0, 2.0];
    let mut a = assign_longest_first(&times, &ones(2)).unwrap();
    assert_eq!(a.makespan(&times, &ones(2)).unwrap(), 7.0);
    assert_eq!(lower_bound(&times, &ones(2)).unwrap(), 6.0);
    exchange(&mut a, &times, &ones(2)).unwrap();
    assert_eq!(a.makespan(&times, &ones(2)).unwrap(), 6.0);
    // All tasks are on one of three nodes. Moves without exchanges distribute them evenly.
    let mut a = Assignment { node_of: vec![1; 9], nodes: 3 };
    exchange(&mut a, &[1.0; 9], &ones(3)).unwrap();
    assert_eq!([0, 1, 2].map(|n| a.node_of.iter().filter(|&&of| of == n).count()), [3, 3, 3]);
    assert!(exchange(&mut Assignment { node_of: vec![0; 2], nodes: 1 }, &[1.0], &ones(1)).is_err());
    assert!(exchange(&mut Assignment { node_of: vec![5; 1], nodes: 1 }, &[1.0], &ones(1)).is_err());
}

#[test]
fn one_long_task_bounds_everything() {
    let mut times = vec![1.0; 20];
    times[19] = 100.0;
    assert_eq!(lower_bound(&times, &ones(8)).unwrap(), 100.0);
    assert_eq!(lower_bound(&times, &[1.0, 4.0]).unwrap(), 25.0);
    assert!(lower_bound(&times, &[]).is_err() && lower_bound(&[f64::NAN], &[1.0]).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn queues_keep_their_promises(
        times in prop::collection::vec(0.0f64..10.0, 0..60),
        guesses in prop::collection::vec(0.0f64..10.0, 60),
        speeds in prop::collection::vec(0.2f64..4.0, 1..8),
    ) {
        let order = longest_first(&guesses[..times.len()]).unwrap();
        let line = simulate_queue(&order, &times, &[], &speeds).unwrap();
        let bound = lower_bound(&times, &speeds).unwrap();
        prop_assert!(line.makespan >= bound * (1.0 - 1e-12));
        // Every task runs once. No node runs two tasks at once, or is idle before its last task.
        let mut seen = vec![false; times.len()];
        for s in &line.spans {
            prop_assert!(!std::mem::replace(&mut seen[s.task], true));
            prop_assert!((s.end - s.start - times[s.task] / speeds[s.node]).abs() < 1e-9);
        }
        for node in 0..speeds.len() {
            let mut at = 0.0;
            for s in line.spans.iter().filter(|s| s.node == node) {
                prop_assert!(s.start == at);
                at = s.end;
            }
        }
        // With every task twice, the makespan is never shorter than with every task once.
        let doubled: Vec<f64> = times.iter().chain(&times).copied().collect();
        let twice: Vec<usize> = order.iter().copied().chain(order.iter().map(|t| t + times.len())).collect();
        prop_assert!(simulate_queue(&twice, &doubled, &[], &speeds).unwrap().makespan >= line.makespan);
    }

    #[test]
    fn more_equal_nodes_never_take_longer(times in prop::collection::vec(0.0f64..10.0, 1..60), nodes in 1usize..12) {
        let order = longest_first(&times).unwrap();
        let few = simulate_queue(&order, &times, &[], &ones(nodes)).unwrap().makespan;
        let more = simulate_queue(&order, &times, &[], &ones(nodes + 1)).unwrap().makespan;
        prop_assert!(more <= few * (1.0 + 1e-12));
    }

    #[test]
    fn longest_first_is_within_grahams_bound_of_the_optimum(times in prop::collection::vec(0.01f64..10.0, 1..9), nodes in 1usize..4) {
        // The shortest makespan of all assignments.
        let all = nodes.pow(times.len() as u32);
        let best = (0..all)
            .map(|code| {
                let node_of = (0..times.len()).map(|t| code / nodes.pow(t as u32) % nodes).collect();
                Assignment { node_of, nodes }.makespan(&times, &ones(nodes)).unwrap()
            })
            .fold(f64::INFINITY, f64::min);
        prop_assert!(lower_bound(&times, &ones(nodes)).unwrap() <= best * (1.0 + 1e-12));
        let got = assign_longest_first(&times, &ones(nodes)).unwrap().makespan(&times, &ones(nodes)).unwrap();
        prop_assert!(got <= best * (4.0 / 3.0 - 1.0 / (3.0 * nodes as f64)) + 1e-9);
    }

    #[test]
    fn exchanges_never_do_harm(times in prop::collection::vec(0.0f64..10.0, 1..60), speeds in prop::collection::vec(0.2f64..4.0, 1..9)) {
        let before = assign_longest_first(&times, &speeds).unwrap();
        let mut after = before.clone();
        exchange(&mut after, &times, &speeds).unwrap();
        let (b, a) = (before.makespan(&times, &speeds).unwrap(), after.makespan(&times, &speeds).unwrap());
        prop_assert!(a <= b * (1.0 + 1e-12), "{a} {b}");
        prop_assert!(a >= lower_bound(&times, &speeds).unwrap() * (1.0 - 1e-12));
        prop_assert!(after.node_of.len() == times.len() && after.node_of.iter().all(|&n| n < speeds.len()));
    }
}

#[test]
fn every_plan_counts_the_loading_times() {
    let text = "task,predicted_s,volume,load_s\na,1,v,10\nb,1,v,10\nc,1,w,10\n";
    let tasks = list(text, "t.csv").unwrap();
    let seconds = times(&tasks, By::Predicted).unwrap();
    for method in [Method::Longest, Method::Queue] {
        let plan = plan(method, &seconds, &ones(1)).unwrap();
        // Both tasks on v come first, since tasks with equal times keep the order of the list.
        assert_eq!(play(&plan, &seconds, &tasks, &ones(1)).unwrap().makespan, 23.0, "{method:?}");
    }
    // Loading takes equally long on a fast and on a slow node.
    assert_eq!(simulate_queue(&[0], &[2.0], &[(0, 5.0)], &[2.0]).unwrap().makespan, 6.0);
}
