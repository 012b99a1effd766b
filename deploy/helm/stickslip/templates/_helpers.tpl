{{/* Every name begins with that of the release. */}}
{{- define "stickslip.name" -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- end }}

{{- define "stickslip.coordinator" -}}
{{ include "stickslip.name" . }}-coordinator
{{- end }}

{{- define "stickslip.url" -}}
http://{{ include "stickslip.coordinator" . }}:8765
{{- end }}

{{/* Labels that a selector has; of a dict with `root` and `component`. */}}
{{- define "stickslip.selector" -}}
app.kubernetes.io/name: stickslip
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "stickslip.labels" -}}
{{ include "stickslip.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ .root.Chart.Name }}-{{ .root.Chart.Version }}
{{- end }}

{{/* What all Pods have in common; of a dict with `root` and `values`. Service links would set STICKSLIP_..._PORT, which
the coordinator takes for settings. */}}
{{- define "stickslip.pod" -}}
serviceAccountName: {{ .root.Values.serviceAccount }}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with .root.Values.imagePullSecrets }}
imagePullSecrets:
  {{- range . }}
  - name: {{ . }}
  {{- end }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  seccompProfile: {type: RuntimeDefault}
{{- with .values.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .values.tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}

{{- define "stickslip.containerSecurity" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}

{{/* Where the store is, and what opens it. */}}
{{- define "stickslip.storeFrom" -}}
{{- with .Values.store.secret }}
envFrom:
  - secretRef: {name: {{ . }}}
{{- end }}
{{- end }}

{{- define "stickslip.settings" -}}
{{- range $name, $value := . }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end }}

{{- define "stickslip.databaseEnv" -}}
- name: STICKSLIP_STORE
  value: {{ .Values.store.url }}
- name: STICKSLIP_DATABASE
  valueFrom:
    secretKeyRef: {name: {{ .Values.database.secret }}, key: {{ .Values.database.key }}}
{{- end }}

{{/* Volumes of the Pods that work: Ray keeps its sockets in /tmp, and its objects in shared memory. */}}
{{- define "stickslip.workerMounts" -}}
- {name: tmp, mountPath: /tmp}
- {name: home, mountPath: /home/stickslip}
- {name: shm, mountPath: /dev/shm}
{{- end }}

{{- define "stickslip.workerVolumes" -}}
- name: tmp
  emptyDir: {sizeLimit: 8Gi}
- name: home
  emptyDir: {sizeLimit: 1Gi}
- name: shm
  emptyDir: {medium: Memory, sizeLimit: 1Gi}
{{- end }}

{{- define "stickslip.keyMount" -}}
- {name: worker-key, mountPath: /etc/stickslip, readOnly: true}
{{- end }}

{{- define "stickslip.keyVolume" -}}
- name: worker-key
  secret:
    secretName: {{ .Values.workerKey.secret }}
    defaultMode: 0440
    items: [{key: {{ .Values.workerKey.key }}, path: worker-key}]
{{- end }}
