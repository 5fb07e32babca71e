//! Model files.

use crate::detach::detached;
use crate::errors::{ModelError, raise};
use crate::lock::Guarded;
use crate::volume::{Data, Volume};
use entire_core::kernels::Executor;
use entire_core::model::{GroupKind, Model as File, ModelFile};
use entire_core::nn::{EncodeScratch, PredNet, VolumeNet};
use entire_steer::predict::{Predictor, load_with};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use std::sync::Arc;

/// A checked model and its networks.
pub(crate) struct Loaded {
    file: File,
    bytes: Vec<u8>,
    net: Option<Arc<PredNet>>,
    encoder: Option<VolumeNet>,
    scratch: Guarded<Option<EncodeScratch>>,
}

impl Loaded {
    pub(crate) fn predictor(&self) -> PyResult<Box<dyn Predictor + Send>> {
        let Some(net) = &self.net else {
            return Err(ModelError::new_err(
                "the model has no prediction network; use a model such as \"unshaded-selected\", or a file \
                 from `entire calibrate` or `entire train`",
            ));
        };
        load_with(net, &self.file).map_err(raise)
    }

    /// The model as a file that can be modified.
    pub(crate) fn model_file(&self) -> PyResult<ModelFile> {
        ModelFile::from_bytes(&self.bytes).map_err(raise)
    }

    /// Returns VolumeNet's output for a volume, or `None` if the model does not take volume features.
    pub(crate) fn features_of(&self, py: Python<'_>, volume: &Data) -> PyResult<Option<Vec<f32>>> {
        if self.file.input_size(GroupKind::VolumeFeatures).is_none() {
            return Ok(None);
        }
        self.encode(py, volume).map(Some)
    }

    fn encode(&self, py: Python<'_>, volume: &Data) -> PyResult<Vec<f32>> {
        let Some(encoder) = &self.encoder else {
            return Err(ModelError::new_err(
                "the model has no volume encoder; use a model such as \"volumenet-64f2\", or a file with \
                 volumenet.* tensors",
            ));
        };
        let mut scratch = self.scratch.lock(py)?;
        let scratch = &mut *scratch;
        detached(py, || {
            let mut features = vec![0.0; encoder.feature_len()];
            let scratch = scratch.get_or_insert_with(|| encoder.scratch());
            encoder.encode(volume.view(), scratch, Executor::Serial, &mut features)?;
            Ok(features)
        })
        .map_err(raise)
    }
}

/// A model file in memory; `entire.Model` opens files and shipped models by name.
#[pyclass(frozen, subclass, module = "entire._native")]
pub(crate) struct Model(pub(crate) Arc<Loaded>);

#[pymethods]
impl Model {
    #[new]
    fn new(py: Python<'_>, data: Vec<u8>) -> PyResult<Self> {
        let loaded = detached(py, || {
            let file = File::from_bytes(&data)?;
            let net = file.prednet.as_ref().map(PredNet::new).transpose()?.map(Arc::new);
            let encoder = file.volumenet.as_ref().map(VolumeNet::new).transpose()?;
            Ok(Loaded { file, bytes: data, net, encoder, scratch: Guarded::new(None) })
        });
        Ok(Self(Arc::new(loaded.map_err(raise)?)))
    }

    /// Encodes a volume into its feature vector.
    ///
    /// Parameters
    /// ----------
    /// volume : Volume
    ///     A volume of any size, which is resampled to the encoder's input size.
    ///
    /// Returns
    /// -------
    /// numpy.ndarray
    ///     float32, shape (n,): VolumeNet's output.
    ///
    /// Raises
    /// ------
    /// ModelError
    ///     For a model without a volume encoder.
    fn encode<'py>(&self, py: Python<'py>, volume: &Volume) -> PyResult<Bound<'py, PyArray1<f32>>> {
        Ok(PyArray1::from_vec(py, self.0.encode(py, &volume.0)?))
    }

    /// list of (str, int) : Input groups of the prediction network and their sizes, in order.
    #[getter]
    fn inputs(&self) -> Vec<(String, usize)> {
        self.0.file.inputs.iter().map(|g| (g.name.clone(), g.size)).collect()
    }

    /// dict of str to str : The file's metadata.
    #[getter]
    fn metadata<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let dict = PyDict::new(py);
        for (key, value) in &self.0.file.metadata {
            dict.set_item(key, value)?;
        }
        Ok(dict)
    }

    /// bool : True if the model predicts frame times.
    #[getter]
    fn predicts(&self) -> bool {
        self.0.net.is_some()
    }

    /// bool : True if the model encodes volumes.
    #[getter]
    fn encodes(&self) -> bool {
        self.0.encoder.is_some()
    }

    /// The file's bytes.
    fn to_bytes<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &self.0.bytes)
    }
}
