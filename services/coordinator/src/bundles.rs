//! `ign.v1.Bundles`: what is published, and under which names.

use std::sync::Arc;

use ign_proto::v1::bundles_server::Bundles;
use ign_proto::{Scope, v1};
use ign_queue::VersionFilter;
use tonic::{Request, Response, Status};

use crate::app::App;
use crate::auth::caller;
use crate::convert::{object_name, optional, to_bundle};
use crate::http_answer::Refused;

type Answer<T> = Result<Response<T>, Status>;

/// Serves `ign.v1.Bundles`.
pub(crate) struct BundlesApi(pub(crate) Arc<App>);

#[tonic::async_trait]
impl Bundles for BundlesApi {
    async fn list(
        &self,
        request: Request<v1::ListBundlesRequest>,
    ) -> Answer<v1::ListBundlesResponse> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let reach = caller
            .reach(Scope::Read)
            .narrow(optional(&request.collection, "collection")?)?;
        let object = optional(&request.object, "object")?;
        let mut versions = Vec::new();
        for collection in reach.each() {
            let filter = VersionFilter {
                collection,
                object: object.clone(),
                include_retired: request.include_retired,
            };
            let found = self.0.store.versions(&filter).await;
            versions.extend(found.map_err(Refused::from)?);
        }
        Ok(Response::new(v1::ListBundlesResponse {
            bundles: versions.into_iter().map(to_bundle).collect(),
        }))
    }

    async fn get(&self, request: Request<v1::GetBundleRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Read], &object.collection)?;
        let version = self
            .0
            .store
            .version(&object, &request.reference)
            .await
            .map_err(Refused::from)?;
        Ok(Response::new(to_bundle(version)))
    }

    async fn set_alias(&self, request: Request<v1::SetAliasRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Admin], &object.collection)?;
        let version = self
            .0
            .store
            .set_alias(&object, &request.reference, &request.alias)
            .await
            .map_err(Refused::from)?;
        self.0.mirror(&object, Some(version.version)).await;
        tracing::info!(object = %object, version = version.version, alias = request.alias, "alias moved");
        Ok(Response::new(to_bundle(version)))
    }

    async fn retire(&self, request: Request<v1::GetBundleRequest>) -> Answer<v1::BundleVersion> {
        let caller = caller(request.extensions())?;
        let request = request.into_inner();
        let object = object_name(request.object.as_ref())?;
        caller.require(&[Scope::Admin], &object.collection)?;
        let version = self
            .0
            .store
            .retire(&object, &request.reference)
            .await
            .map_err(Refused::from)?;
        self.0.mirror(&object, Some(version.version)).await;
        tracing::info!(object = %object, version = version.version, "version retired");
        Ok(Response::new(to_bundle(version)))
    }
}
