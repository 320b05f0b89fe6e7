from .exports import render_html as render_html
from .options import OVERLAY_KINDS as OVERLAY_KINDS
from .plots import plot_funnel as plot_funnel
from .plots import plot_policy as plot_policy
from .plots import plot_run as plot_run
