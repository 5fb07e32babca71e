//! `entire doctor`: report what is installed here and what works with it.

use crate::calibrate::place::{DATA_FOLDER, file_of, machine_model, volumes_in};
use crate::shipped::shipped_models;
use entire_core::kernels::Level;
use entire_core::scene::Shading;
use entire_io::child::wait_at_most;
use entire_io::machine;
use entire_io::options::is_software;
use entire_vk_raycaster::{Renderer, VulkanOptions, VulkanRaycaster};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

/// Report what is installed here and what works with it.
///
/// Looks for a Vulkan device, models of this machine, VTK, PyVista, 3D Slicer, trame, napari, vispy and yt,
/// ParaView, the C library and the engines of render farms. For each part that it finds, it prints the
/// version, the use and, for adapters to other renderers, the tested versions. For each missing part, it
/// prints the use and, for most parts, how to install it. A missing part is no error: the CPU version of the
/// raycaster renders anywhere.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire doctor
  entire doctor --python venv/bin/python")]
pub(crate) struct Options {
    /// Python interpreter that is searched for packages.
    #[arg(long, default_value = "python3", value_name = "PROGRAM")]
    pub(crate) python: String,
}

/// Python interpreter of the system; Linux distributions package VTK for it.
const SYSTEM_PYTHON: &str = "/usr/bin/python3";

/// Time limit of each program that this command runs.
const PROGRAM_TIME_LIMIT: Duration = Duration::from_secs(20);

const PACKAGES: [(&str, &str); 9] = [
    ("vtk", "steering of VTK in Python by entire.vtk.hold"),
    ("pyvista", "steering of PyVista by pl.entire.hold(fps=15)"),
    ("slicer-core", "steering of 3D Slicer's views by entire.slicer.hold"),
    ("trame-slicer", "steering of 3D Slicer's views in a browser by entire.slicer.hold"),
    ("trame", "steering of volumes in a browser by entire.trame.watch"),
    ("napari", "steering of napari's volumes by entire.napari.hold"),
    ("vispy", "steering of vispy's volumes by entire.vispy.hold"),
    ("yt", "steering of yt's scenes by entire.yt.hold"),
    ("entire", "prediction and steering in Python"),
];

/// Versions with which the adapters passed all of their tests: lines of a name and of versions, each of two
/// numbers. `make versions` writes the file.
const TESTED_VERSIONS: &str = include_str!("tested-versions.txt");

/// The version of a part, or the command that installs a missing part.
type Finding = Result<String, &'static str>;

pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    println!("entire {}", machine::version());
    heading("Machine");
    found("processor", &machine::machine());
    found("inference", &format!("with {} instructions", Level::detect().isa()));
    found("raycaster", &raycaster());

    heading("Models");
    for shading in Shading::ALL {
        let name: &str = shading.into();
        let shipped = shipped_models(shading)?.len();
        let model = match machine_model(shading) {
            Ok(Some((path, _, clock))) => {
                format!("{}, clock: {}", path.display(), clock.map_or("not stated", |c| c.name()))
            }
            Err(error) => format!("{error:#}"),
            Ok(None) => format!(
                "{shipped} shipped, no model of this machine (`entire calibrate --shade {name}` makes {})",
                file_of(shading).map_or("one with --out".into(), |p| p.display().to_string())
            ),
        };
        found(&format!("shading {name}"), &model);
    }
    match volumes_in(Path::new(DATA_FOLDER)).map_or(0, |v| v.len()) {
        0 => found("volumes", "none in data/; name your own files: `entire calibrate VOLUME…`"),
        n => found("volumes", &format!("{n} in data/, for calibration")),
    }

    heading("Renderers");
    let (asked, system) = (packages_of(&options.python), packages_of(SYSTEM_PYTHON));
    for (package, used_for) in PACKAGES {
        print(&format!("{package} (Python)"), package, used_for, &python_package(package, &asked, &system));
    }
    let slicer = "steering of its views by entire.slicer.hold, if its Python has the package entire";
    let remedy = "https://download.slicer.org";
    print("3D Slicer", "", slicer, &version_of("Slicer", &["--version"], remedy));
    let plugin = "steering by entire's plugin, built for exactly this version of ParaView (`make \
                  test-paraview` builds it)";
    print("ParaView", "ParaView", plugin, &version_of("pvbatch", &["--version"], "apt-get install paraview"));
    print("VTK for C++", "VTK", "the class vtkEntireSteering (`make test-vtk`)", &vtk_for_cxx());
    let library = version_of("pkg-config", &["--modversion", "entire"], "make install PREFIX=…");
    print("libentire", "", "C and C++ renderers", &library);

    heading("Render farms");
    let engines = "running `entire farm` on several machines";
    print("Slurm", "", engines, &version_of("sbatch", &["--version"], "apt-get install slurm-wlm"));
    // The farm runs HyperQueue by its Python package, not by its command `hq`.
    let version = ["-c", "from importlib.metadata import version; print(version('hyperqueue'))"];
    let remedy = "run `pip install hyperqueue` with the Python that --python names (default: python3)";
    print("HyperQueue", "", engines, &version_of(&options.python, &version, remedy));
    Ok(())
}

fn heading(text: &str) {
    println!("\n{text}");
}

fn found(name: &str, text: &str) {
    println!("  {name:<21} {text}");
}

/// Prints a line of the report. `part` is the part's name in [`TESTED_VERSIONS`].
fn print(name: &str, part: &str, used_for: &str, finding: &Finding) {
    match finding {
        Ok(version) => found(name, &format!("{version}: {used_for}{}", tested_with(part, version))),
        Err(remedy) => found(name, &format!("not found; needed for {used_for}; to install it: {remedy}")),
    }
}

/// Returns the end of a found part's line, which says if its version was tested, or else names the tested
/// versions. Empty if no version of the part is in [`TESTED_VERSIONS`].
fn tested_with(part: &str, version: &str) -> String {
    let Some(versions) =
        TESTED_VERSIONS.lines().filter_map(|l| l.split_once(": ")).find(|(name, _)| *name == part)
    else {
        return String::new();
    };
    let versions = versions.1;
    // The first word that begins with a digit is the number; the text may have a name before it.
    let number =
        version.split([' ', ',']).find(|w| w.starts_with(|c: char| c.is_ascii_digit())).unwrap_or("");
    let mut parts = number.split('.');
    let number = format!("{}.{}", parts.next().unwrap_or(""), parts.next().unwrap_or(""));
    if versions.split(' ').any(|v| v == number) {
        "; tested with this version".into()
    } else {
        format!("; not tested with this version, but with {}", versions.replace(' ', ", "))
    }
}

/// Description of the renderer that `--device auto` opens.
fn raycaster() -> String {
    let options = match VulkanOptions::from_env() {
        Ok(options) => options,
        Err(error) => return format!("none: {error}"),
    };
    let named = options.device.is_some();
    match VulkanRaycaster::new(options) {
        Ok(renderer) => {
            let software = is_software(&renderer);
            let kind = if software { "a software driver" } else { "a GPU" };
            let clock = if renderer.has_timestamps() && !software { "device" } else { "wall" };
            format!(
                "Vulkan on {} ({kind}); models and steering use {clock} time by default",
                renderer.device()
            )
        }
        // If the environment names a device, the CPU version does not replace it.
        Err(error) if named => format!("none, except by --device cpu: {error}"),
        Err(error) => format!("on the CPU, without Vulkan: {error}"),
    }
}

/// Returns the output of a program, or `None` if it is missing, fails, or takes too long.
fn output_of(program: &str, arguments: &[&str]) -> Option<String> {
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .ok()?;
    wait_at_most(&mut child, PROGRAM_TIME_LIMIT).ok()??;
    let output = child.wait_with_output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// The first non-blank line of a program's output, or "installed" if all lines are blank. `None` as in
/// [`output_of`].
fn first_line(program: &str, arguments: &[&str]) -> Option<String> {
    let text = output_of(program, arguments)?;
    Some(text.lines().map(str::trim).find(|l| !l.is_empty()).unwrap_or("installed").to_owned())
}

fn version_of(program: &str, arguments: &[&str], remedy: &'static str) -> Finding {
    first_line(program, arguments).ok_or(remedy)
}

/// Returns the version of the newest CMake package of VTK in folders that CMake searches by default.
fn vtk_for_cxx() -> Finding {
    let children = |folder: &Path| -> Vec<PathBuf> {
        std::fs::read_dir(folder)
            .map_or(Vec::new(), |entries| entries.filter_map(|e| Some(e.ok()?.path())).collect())
    };
    let lib = ["/usr/lib", "/usr/local/lib"].map(PathBuf::from);
    let folders = lib.iter().cloned().chain(lib.iter().flat_map(|folder| children(folder)));
    let mut versions: Vec<(Vec<u32>, String)> = folders
        .flat_map(|folder| children(&folder.join("cmake")))
        .filter(|package| package.join("vtk-config.cmake").is_file())
        .filter_map(|package| {
            let version = package.file_name()?.to_str()?.strip_prefix("vtk-")?.to_owned();
            Some((version.split('.').filter_map(|n| n.parse().ok()).collect(), version))
        })
        .collect();
    versions.sort();
    let newest = versions.pop().map(|(_, version)| version);
    newest.ok_or("apt-get install libvtk9-dev")
}

/// Python code that prints the name and the version of each installed package among its arguments. It reads
/// metadata instead of importing packages. Only Debian's VTK is imported, since it has no metadata.
const LIST_PACKAGES: &str = "
import importlib.metadata, importlib.util, sys
for name in sys.argv[1:]:
    try:
        print(name, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        if name == 'vtk' and importlib.util.find_spec('vtkmodules'):
            from vtkmodules.vtkCommonCore import vtkVersion
            print(name, vtkVersion.GetVTKVersion())
        elif importlib.util.find_spec(name):
            print(name, 'installed')
";

/// Versions of the installed packages of a Python interpreter; empty if there is no such interpreter.
fn packages_of(python: &str) -> BTreeMap<String, String> {
    let names = PACKAGES.map(|(package, _)| package);
    let text = output_of(python, &[&["-c", LIST_PACKAGES], &names[..]].concat()).unwrap_or_default();
    text.lines().filter_map(|l| l.split_once(' ')).map(|(n, v)| (n.to_owned(), v.to_owned())).collect()
}

/// Returns the version of a package in the Python interpreter of `--python`, else in [`SYSTEM_PYTHON`].
fn python_package(
    package: &str,
    asked: &BTreeMap<String, String>,
    system: &BTreeMap<String, String>,
) -> Finding {
    match (asked.get(package), system.get(package)) {
        (Some(version), _) => Ok(version.clone()),
        (None, Some(version)) => Ok(format!("{version}, only in {SYSTEM_PYTHON}")),
        (None, None) if package == "entire" => Err("make wheel, then pip install out/wheels/entire-*.whl"),
        (None, None) => Err("run `pip install` with the Python that --python names (default: python3)"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_its_first_line_and_a_failure_none() {
        assert_eq!(first_line("sh", &["-c", "echo; echo ' 9.1 '; echo more"]).as_deref(), Some("9.1"));
        assert_eq!(first_line("sh", &["-c", "true"]).as_deref(), Some("installed"));
        assert_eq!(first_line("sh", &["-c", "echo 9.1; false"]), None);
        assert_eq!(first_line("entire-no-such-program", &[]), None);
    }

    #[test]
    fn a_missing_package_has_a_remedy() {
        let none = packages_of("entire-no-such-python");
        let finding = python_package("entire_no_such_package", &none, &none);
        assert!(matches!(finding, Err(remedy) if remedy.contains("pip install")));
    }

    #[test]
    fn tested_versions_are_told_from_others() {
        let (name, versions) =
            TESTED_VERSIONS.lines().next().expect("a line").split_once(": ").expect("a name");
        let first = versions.split(' ').next().expect("a version");
        for text in [format!("{first}.7"), format!("{name} version {first}.0"), first.to_owned()] {
            assert_eq!(tested_with(name, &text), "; tested with this version", "{text}");
        }
        for text in ["99.1.0", "installed", "9"] {
            assert!(
                tested_with(name, text).starts_with("; not tested with this version, but with "),
                "{text}"
            );
        }
        assert_eq!(tested_with("entire", "0.1.0"), "");
        // Names of the file are those that the report uses.
        for name in TESTED_VERSIONS.lines().filter_map(|l| Some(l.split_once(": ")?.0)) {
            assert!(["VTK", "ParaView"].contains(&name) || PACKAGES.iter().any(|p| p.0 == name), "{name}");
        }
    }
}
