//! Stage `critic`: gathers what a criticism of the model needs, and leaves it in a file.
//!
//! It stands in the place of the estimators, behind the effects of the model and every candidate. The mathematics is that of
//! `core/identification`; here columns become its candidate_set.

mod stage;

pub use stage::Critic;

dragfree_sdk::export_plugin!(stages: [Critic]);
