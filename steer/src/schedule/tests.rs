use super::*;
use alloc::vec;
use entire_core::ErrorKind;
use proptest::prelude::*;

fn ones(n: usize) -> Vec<f64> {
    vec![1.0; n]
}

/// The shortest makespan on identical nodes, by trying every assignment.
fn optimum(times: &[f64], nodes: usize) -> f64 {
    fn go(times: &[f64], loads: &mut Vec<f64>, best: &mut f64) {
        let Some((&t, rest)) = times.split_first() else {
            *best = best.min(loads.iter().copied().fold(0.0, f64::max));
            return;
        };
        for n in 0..loads.len() {
            loads[n] += t;
            if loads[n] < *best {
                go(rest, loads, best);
            }
            loads[n] -= t;
        }
    }
    let mut best = f64::INFINITY;
    go(times, &mut ones(nodes).iter().map(|_| 0.0).collect(), &mut best);
    best
}

#[test]
fn grahams_worst_case_is_met_exactly() {
    // Two nodes, tasks 3 3 2 2 2: longest first ends at 7, the best schedule at 6.
    let times = [3.0, 3.0, 2.0, 2.0, 2.0];
    let a = assign_longest_first(&times, &ones(2)).unwrap();
    assert_eq!(a.makespan(&times, &ones(2)).unwrap(), 7.0);
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
fn nonsense_is_refused_with_the_culprit_named() {
    let kind = |r: Result<Assignment>| r.unwrap_err();
    assert!(kind(assign_longest_first(&[1.0], &[])).to_string().contains("no nodes"));
    assert!(kind(assign_longest_first(&[1.0, f64::NAN], &[1.0])).to_string().contains("task 1"));
    assert!(kind(assign_longest_first(&[-1.0], &[1.0])).to_string().contains("task 0"));
    assert!(kind(assign_longest_first(&[1.0], &[1.0, 0.0])).to_string().contains("node 1"));
    assert!(kind(assign_longest_first(&[1e308; 2], &[2.0, 1.0])).to_string().contains("add up to more"));
    assert!(assign_longest_first(&[1e308; 2], &[4.0, 2.0]).is_ok());
    let many = alloc::vec![1.0; MAX_NODES + 1];
    assert!(assign_longest_first(&[1.0], &many[1..]).is_ok());
    assert!(
        kind(assign_longest_first(&[1.0], &many)).to_string().contains("1048577 nodes, but at most 1048576")
    );
    let a = assign_longest_first(&[1.0, 2.0], &[1.0]).unwrap();
    assert_eq!(a.makespan(&[1.0], &[1.0]).unwrap_err().kind(), ErrorKind::SizeMismatch);
    let astray = Assignment { node_of: vec![5], nodes: 1 }.makespan(&[1.0], &[1.0]).unwrap_err();
    assert!(astray.to_string().contains("names node 5; its 1 nodes are numbered from 0"), "{astray}");
    assert_eq!(assign_longest_first(&[], &[1.0]).unwrap().makespan(&[], &[1.0]).unwrap(), 0.0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn longest_first_is_within_grahams_bound_of_the_optimum(times in prop::collection::vec(0.01f64..10.0, 1..9), nodes in 1usize..4) {
        let best = optimum(&times, nodes);
        let got = assign_longest_first(&times, &ones(nodes)).unwrap().makespan(&times, &ones(nodes)).unwrap();
        prop_assert!(got <= best * (4.0 / 3.0 - 1.0 / (3.0 * nodes as f64)) + 1e-9);
    }
}
