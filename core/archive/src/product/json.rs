//! The product as `run --json` and `products show --json` print it; the keys are a contract.

use super::file::Product;
use serde_json::{Map, Value, json};
use std::path::Path;

/// The product that lies at `path`; a missing number is `null`.
pub fn to_json(product: &Product, path: &Path) -> Value {
    let attributes = &product.header.non_standard_attributes;
    let quality = &product.quality;
    let covariance = &product.result.covariance;
    let matrices: Map<_, _> = covariance.iter().map(|(solution, c)| (solution.clone(), json!(c.matrix))).collect();
    let names: Map<_, _> = covariance.iter().map(|(solution, c)| (solution.clone(), json!(c.names))).collect();
    json!({
        "id": product.id(),
        "path": path.to_string_lossy(),
        "epochs_used": quality.epochs_used,
        "epochs_rejected": quality.epochs_rejected,
        "commands": quality.commands,
        "coefficients": product.result.coefficients,
        "covariance": matrices,
        "covariance_names": names,
        "verdict": product.result.verdict,
        "weak_directions": quality.weak_directions,
        "chi2_per_dof": quality.chi2_per_dof,
        "nis": quality.nis,
        "model": product.model,
        "data_loss": quality.data_loss,
        "inconsistent": quality.inconsistent,
        "losses": product.losses,
        "quality": quality,
        "mission": product.header.global_attributes.project,
        "spacecraft": product.header.global_attributes.platform,
        "day": attributes.day,
        "time_scale": attributes.time_scale,
        "start_time_epoch_ns": attributes.start_time_epoch_ns,
        "stop_time_epoch_ns": attributes.stop_time_epoch_ns,
        "date_created": product.header.global_attributes.date_created,
        "software_version": attributes.software_version,
        "sha256": attributes.sha256,
        "supersedes": product.supersedes,
        "inputs": product.inputs,
        "history": product.history,
        "attachments": product.attachments,
    })
}
