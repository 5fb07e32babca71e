//! Cinema Specification D: a folder `NAME.cdb` with a table `data.csv`, one row per image; columns whose
//! names begin with FILE hold paths relative to the folder.

use super::job::Job;
use super::record::Answer;
use anyhow::Result;
use entire_io::files::write_whole_with;
use std::collections::HashMap;

const COLUMNS: &str = "volume time rx_deg ry_deg dz_radii transfer width height step predicted_s measured_s \
                       load_s node task FILE";

/// Writes the table of a job's images, in the order of the job's tasks.
pub(crate) fn write(job: &Job, done: &HashMap<u32, Answer>) -> Result<()> {
    let mut tasks: Vec<u32> = done.keys().copied().collect();
    tasks.sort_unstable();
    write_whole_with(&job.output.join("data.csv"), |file| {
        let mut table = csv::Writer::from_writer(file);
        table.write_record(COLUMNS.split(' '))?;
        for task in tasks {
            let (at, answer) = (job.place(task as usize), &done[&task]);
            let (volume, camera, size) =
                (&job.volumes[at.volume], job.cameras[at.camera], job.sizes[at.size]);
            let id = job.id(task as usize);
            table.write_record([
                volume.name.clone(),
                volume.time.to_string(),
                camera.rx.to_string(),
                camera.ry.to_string(),
                camera.dz.to_string(),
                job.transfers[at.transfer].name.clone(),
                size[0].to_string(),
                size[1].to_string(),
                job.steps[at.step].to_string(),
                format!("{:.6}", answer.predicted_s),
                format!("{:.6}", answer.seconds),
                format!("{:.6}", answer.load_s),
                answer.node.clone(),
                format!("{id:016x}"),
                job.image(id),
            ])?;
        }
        table.flush()?;
        Ok(())
    })
}
