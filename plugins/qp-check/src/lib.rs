//! See ARCHITECTURE.md.

pub mod estimate;
pub mod normal;
pub mod qp;
pub(crate) mod refine;
pub mod segments;
pub mod sigma;
pub mod spectra;
pub mod verdict;
