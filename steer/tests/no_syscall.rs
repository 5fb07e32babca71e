//! Tests that predictions, plans, observations and repeated encodings make no system call after set-up.
//!
//! Each case runs in a process of its own. After set-up the process enters seccomp's strict mode, in which
//! the kernel kills it at the first system call other than read, write, exit and sigreturn. If the kernel
//! refuses this mode, the cases are reported as ignored.

use libtest_mimic::{Arguments, Failed, Trial};
use std::process::ExitCode;

/// Environment variable with the name of the case that a child process runs.
const CASE: &str = "ENTIRE_NO_SYSCALL_CASE";

fn main() -> ExitCode {
    if let Some(case) = std::env::var_os(CASE) {
        child::run(&case.to_string_lossy());
    }
    let arguments = Arguments::from_args();
    let possible = status("nothing").is_ok_and(|s| s.success());
    let trial = |name: &'static str| {
        // The list of expected skips (.ci/expected-skips) names these tests by their file.
        Trial::test(format!("no_syscall::{name}"), move || match status(name) {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(Failed::from(format!("the child ended with {status}"))),
            Err(error) => Err(Failed::from(error.to_string())),
        })
        .with_ignored_flag(!possible)
    };
    let trap = Trial::test("no_syscall::a_system_call_is_noticed", || match status("system call") {
        Ok(status) if !status.success() => Ok(()),
        Ok(_) => Err(Failed::from("the child made a system call and was not killed")),
        Err(error) => Err(Failed::from(error.to_string())),
    })
    .with_ignored_flag(!possible);
    let mut trials: Vec<Trial> = child::CASES.iter().map(|name| trial(name)).collect();
    trials.push(trap);
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn status(case: &str) -> std::io::Result<std::process::ExitStatus> {
    std::process::Command::new(std::env::current_exe()?).env(CASE, case).status()
}

#[cfg(not(all(target_os = "linux", target_arch = "x86_64")))]
mod child {
    pub(crate) const CASES: [&str; 0] = [];

    /// Exits with status 77, since the cases run on x86-64 Linux only.
    pub(crate) fn run(_: &str) -> ! {
        std::process::exit(77)
    }
}

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
mod child {
    use entire_core::kernels::Level;
    use entire_core::kernels::{Executor, Storage};
    use entire_core::nn::{
        ConvBlockParts, DenseParts, Dtype, PredNet, PredNetParts, Target, VolumeNet, VolumeNetParts,
    };
    use entire_core::scene::{Arcball, Camera, Frame, GaussianLobe, Scalars, TransferFunction, VolumeView};
    use entire_steer::control::ObserveFlags;
    use entire_steer::control::Session;
    use entire_steer::features::VolumeSummary;

    pub(crate) const CASES: [&str; 3] = ["predict", "plan_and_observe", "encode_again"];

    #[allow(
        unsafe_code,
        reason = "seccomp needs system calls, and the standard library's exit makes more calls than exit"
    )]
    fn system_call(number: usize, a: usize, b: usize) -> isize {
        let result: isize;
        // SAFETY: the system calls made here (prctl(PR_SET_SECCOMP, SECCOMP_MODE_STRICT), getpid and exit)
        // access no memory.
        unsafe {
            std::arch::asm!("syscall", inlateout("rax") number as isize => result, in("rdi") a, in("rsi") b,
                            in("rdx") 0, out("rcx") _, out("r11") _, options(nostack));
        }
        result
    }

    fn exit(status: usize) -> ! {
        loop {
            system_call(60, status, 0);
        }
    }

    fn strict() {
        if system_call(157, 22, 1) != 0 {
            exit(77);
        }
    }

    /// Runs a case, which must not make a system call after it calls `strict`.
    pub(crate) fn run(case: &str) -> ! {
        match case {
            "predict" => predict(),
            "plan_and_observe" => plan(),
            "encode_again" => encode(),
            "system call" => {
                strict();
                end(system_call(39, 0, 0) > 0)
            }
            _ => {
                strict();
                end(true)
            }
        }
    }

    /// Ends the process without running destructors, since freeing memory may make a system call.
    fn end(fine: bool) -> ! {
        exit(usize::from(!fine))
    }

    fn number(i: usize) -> f32 {
        ((i * 2_654_435_761) % 1000) as f32 / 5000.0 - 0.1
    }

    fn dense(inputs: usize, outputs: usize) -> DenseParts {
        DenseParts {
            inputs,
            outputs,
            weight: (0..inputs * outputs).map(number).collect(),
            bias: (0..outputs).map(number).collect(),
            dtype: Dtype::F32,
        }
    }

    fn predict() -> ! {
        let parts = PredNetParts {
            layers: vec![dense(16, 256), dense(256, 64), dense(64, 1)],
            input: None,
            output: None,
            target: Target::LogSeconds,
        };
        let nets: Vec<PredNet> = Level::available()
            .flat_map(|level| Storage::ALL.map(|storage| (level, storage)))
            .map(|(level, storage)| PredNet::with(&parts, level, storage).expect("a network"))
            .collect();
        let mut scratches: Vec<_> =
            nets.iter().map(|net| (net.scratch(1).unwrap(), net.scratch(40).unwrap())).collect();
        let inputs: Vec<f32> = (0..16 * 40).map(number).collect();
        let mut seconds = vec![0.0; 40];
        let mut fine = true;
        strict();
        for _ in 0..100 {
            for (net, (one, many)) in nets.iter().zip(&mut scratches) {
                fine &= net.predict(&inputs[..16], one).is_finite();
                fine &= net
                    .predict_batch(Executor::Serial, &inputs, &mut seconds, std::slice::from_mut(many))
                    .is_ok();
            }
        }
        end(fine)
    }

    fn plan() -> ! {
        let n = 32;
        let bytes: Vec<u8> = (0..n * n * n).map(|i| (i * 193 % 251) as u8).collect();
        let view = VolumeView::new(Scalars::U8(&bytes), [n; 3]).expect("a volume");
        let summary = VolumeSummary::new(&view).expect("a summary");
        let lobe = GaussianLobe { center: 0.5, width: 0.02, height: 0.1 };
        let table = TransferFunction::Gaussian(vec![lobe]).to_table().expect("a table");
        let frames: Vec<Frame> = (0..40)
            .map(|i| {
                let pose = Arcball { rx: 20.0, ry: 9.0 * i as f32, dz: 1.6 };
                Frame::new(Camera::from_arcball(pose).expect("a camera"), 320, 200).expect("a frame")
            })
            .collect();
        let mut session = Session::default();
        session.set_volume(summary, None);
        session.set_transfer(&table, None).expect("a volume is set");
        let mut fine = true;
        strict();
        for i in 0..400 {
            match session.plan(&frames[i % 40], 0.02) {
                Ok(plan) => {
                    let seconds = 0.015 + 1e-5 * (i % 7) as f32;
                    fine &= session.observe(plan.id, seconds, ObserveFlags::default()).is_ok();
                }
                Err(_) => fine = false,
            }
        }
        end(fine)
    }

    fn encode() -> ! {
        let block = |inputs: usize, outputs: usize, input_edge: usize| ConvBlockParts {
            inputs,
            outputs,
            kernel: 3,
            stride: 2,
            padding: 1,
            weight: (0..outputs * inputs * 27).map(number).collect(),
            bias: (0..outputs).map(number).collect(),
            input_edge,
            output_edge: input_edge / 2,
            dtype: Dtype::F32,
        };
        let blocks = vec![block(1, 8, 16), block(8, 16, 8), block(16, 32, 4)];
        let parts = VolumeNetParts { input: 16, blocks, fc: dense(32 * 8, 4) };
        let nets: Vec<VolumeNet> =
            Level::available().map(|level| VolumeNet::with(&parts, level).expect("a network")).collect();
        let bytes: Vec<u8> = (0..40 * 40 * 40).map(|i| (i * 193 % 251) as u8).collect();
        let view = |dims| VolumeView::new(Scalars::U8(&bytes), dims).expect("a volume");
        let views = [view([16; 3]), view([40; 3]), view([32; 3]), view([9, 40, 3])];
        let mut scratches: Vec<_> = nets.iter().map(VolumeNet::scratch).collect();
        let mut features = [0.0; 4];
        let mut fine = true;
        let mut all = |fine: &mut bool| {
            for (net, scratch) in nets.iter().zip(&mut scratches) {
                for view in &views {
                    *fine &= net.encode(view, scratch, Executor::Serial, &mut features).is_ok();
                    *fine &= features.iter().all(|f| f.is_finite());
                }
            }
        };
        all(&mut fine);
        strict();
        for _ in 0..5 {
            all(&mut fine);
        }
        end(fine)
    }
}
