//! A request that is not answered, and why.

/// Refusal of a request: the status of HTTP and a sentence for the user.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{sentence}")]
pub struct Refusal {
    /// Status of HTTP, such as 403.
    pub status: u16,
    /// Sentence for the user: the fault and its remedy.
    pub sentence: String,
}

impl Refusal {
    /// Creates a refusal with this status and sentence.
    pub fn new(status: u16, sentence: impl Into<String>) -> Self {
        Self { status, sentence: sentence.into() }
    }

    /// Creates the refusal of a value that the user gave, status 400.
    pub fn of_value(sentence: impl Into<String>) -> Self {
        Self::new(400, sentence)
    }
}
