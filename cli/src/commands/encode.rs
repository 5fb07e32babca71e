//! `entire encode`: turn a volume into its feature vector.

use anyhow::{Context, Result, bail};
use entire_core::kernels::Executor;
use entire_core::nn::VolumeNet;
use entire_io::files::{digits, open_model};
use entire_io::options::thread_pool;
use entire_io::volume::{Reading, open_volume};
use std::path::PathBuf;

/// Compute the feature vector of a volume by a VolumeNet.
///
/// The scalars are mapped from the volume's range to [0, 1]; --range sets another range, such as that of an
/// ensemble. Then the volume is resampled to the network's input size and encoded. Prints the features on one
/// line, comma-separated, with 9 significant digits.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  entire encode --model volumenet.safetensors data/mr_banana.nrrd
  entire encode --model volumenet.safetensors --range -1024,3071 ct.nii.gz")]
pub(crate) struct Options {
    /// Model file with a VolumeNet.
    #[arg(long, value_name = "M.safetensors")]
    pub(crate) model: PathBuf,
    /// Volume file: .nrrd, .nhdr, .mhd, .mha, .vti, .nii, .nii.gz, .json, .raw or .raw.gz.
    pub(crate) volume: PathBuf,
    /// Options for reading the volume.
    #[command(flatten)]
    pub(crate) reading: Reading,
    /// Number of threads; default: one per logical processor.
    #[arg(long)]
    pub(crate) threads: Option<usize>,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    let model = open_model(&options.model)?;
    let Some(parts) = model.volumenet.as_ref() else {
        bail!(
            "{}: has no VolumeNet (volumenet.encoder.0.conv.weight); give a model that encodes volumes",
            options.model.display()
        );
    };
    let net = VolumeNet::new(parts).with_context(|| format!("{}", options.model.display()))?;
    let volume = open_volume(&options.volume, &options.reading)?;
    let pool = thread_pool(options.threads)?;
    let mut features = vec![0.0; net.feature_len()];
    net.encode(&volume.view(), &mut net.scratch(), Executor::Rayon(&pool), &mut features)
        .with_context(|| format!("{}", options.volume.display()))?;
    if let Some(at) = features.iter().position(|f| !f.is_finite()) {
        bail!(
            "{}: feature {at} is {}; the model's weights are too large for this volume",
            options.volume.display(),
            features[at]
        );
    }
    println!("{}", features.iter().map(|&f| digits(f)).collect::<Vec<_>>().join(","));
    Ok(())
}
