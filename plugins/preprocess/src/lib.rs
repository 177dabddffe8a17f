//! Stage `preprocess`.
mod bytes;
mod clock;
mod gridder;
mod layout;
mod outliers;
mod series;
#[cfg(test)]
mod testing;
